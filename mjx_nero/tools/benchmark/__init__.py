"""Measures the speed of this machine: python -m mjx_nero benchmark --env nero_lift --num-envs 1024,4096 --impl native,jax

``throughput`` measures steps, resets, training and controllers of many environments; ``learning`` the time to success of
several seeds; ``inverse_kinematics`` poses; ``drawing`` frames. ``command`` reads the flags, keeps the rows and shows them.
"""

SIZES = (1024, 4096, 16384)  # numbers of environments, unless --num-envs is given
