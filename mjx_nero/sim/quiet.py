"""Imports MJX, without the lines that it prints where Warp, which only GPUs need, is missing. To be imported before Brax."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    import mujoco.mjx  # noqa: F401
