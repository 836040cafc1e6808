"""Speed of this machine: python -m mjx_nero benchmark --env nero_lift --num-envs 1024,4096 --impl native,jax

``throughput`` has steps, resets, training and controllers of many environments; ``learning`` the time to success of several
seeds; ``inverse_kinematics`` poses; ``drawing`` frames. ``command`` takes the flags, keeps the rows and shows them.
"""

from mjx_nero.tools.benchmark.command import main
from mjx_nero.tools.benchmark.inverse_kinematics import measure_ik, measure_mink

__all__ = ["main", "measure_ik", "measure_mink"]
