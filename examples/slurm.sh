#!/bin/bash
# Trains under Slurm, on all GPUs of the allocated machines: sbatch examples/slurm.sh --env nero_lift
# When its time is nearly up, or when it is preempted, the run saves and returns to the queue; the same command resumes it.
#SBATCH --job-name=mjx_nero
#SBATCH --nodes=1
#SBATCH --ntasks-per-node=1
#SBATCH --gpus-per-node=1
#SBATCH --cpus-per-task=8
#SBATCH --time=04:00:00
#SBATCH --requeue
#SBATCH --signal=USR1@120

srun python train.py --out "runs/slurm_${SLURM_JOB_ID}" --resume auto "$@"
code=$?
# 128 and the signal's number: 10 is USR1, 15 TERM.
if [ $code -eq 138 ] || [ $code -eq 143 ]; then
    scontrol requeue "$SLURM_JOB_ID"
    exit 0
fi
exit $code
