"""Robots of one joint: something on a slide, half a metre above the table."""

from mjx_nero.sim.robot import DriveCfg, RobotCfg

_AXES = {"x": "1 0 0", "z": "0 0 1"}
_MJCF = """
<mujoco>
  <worldbody>
    <body name="base_link">
      <body name="{name}">
        <joint name="{axis}" type="slide" axis="{direction}" range="-1 1"/>
        {inside}
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def robot(name: str, axis: str, inside: str, stiffness: float, damping: float, effort: float) -> RobotCfg:
    """A robot whose body ``name`` holds ``inside``, with the site ``ee``, and moves along an axis, which names the joint."""
    drive = DriveCfg((axis,), (stiffness,), (damping,), (effort,), (1.0,), (0.0,))
    text = _MJCF.format(name=name, axis=axis, direction=_AXES[axis], inside=inside)
    return RobotCfg(name=name, mjcf=text, arm=drive, base_pos=(0.0, 0.0, 0.5))
