"""Write NAME_fk.npz: reference link poses of a robot, computed from its URDF with yourdfpy.

    python tests/data/make_fk.py nero path/to/nero_gripper.urdf
    python tests/data/make_fk.py piper path/to/piper_gripper.urdf
    python tests/data/make_fk.py so_arm100 path/to/so_arm100.urdf
    python tests/data/make_fk.py so_arm101 path/to/so_arm101.urdf

The URDFs are those named in assets/NAME/README.md. Poses are relative to the base link, so the mount does not enter: the URDF's
root or, where that is an empty ``world``, its only child. Meshes are not needed.
"""

import argparse
from pathlib import Path

import numpy as np
import yourdfpy
from trimesh.transformations import quaternion_from_matrix

COUNT = 100
SEED = 0


def base_link(robot: yourdfpy.URDF) -> str:
    root = robot.link_map[robot.base_link]
    if root.name != "world" or root.inertial or root.visuals or root.collisions:
        return root.name
    (child,) = (joint.child for joint in robot.joint_map.values() if joint.parent == root.name)
    return child


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", help="of the robot, as in assets/")
    parser.add_argument("urdf", type=Path)
    args = parser.parse_args()

    robot = yourdfpy.URDF.load(str(args.urdf), build_scene_graph=True, load_meshes=False)
    base = base_link(robot)
    joints = robot.actuated_joint_names
    links = [name for name in robot.link_map if name not in (robot.base_link, base)]
    limits = [robot.joint_map[name].limit for name in joints]
    lower, upper = np.array([(lim.lower, lim.upper) for lim in limits]).T

    # The first vector is the zero pose, the others fill the joint ranges.
    qpos = np.random.default_rng(SEED).uniform(lower, upper, size=(COUNT, len(joints)))
    qpos[0] = 0.0

    pos = np.empty((COUNT, len(links), 3))
    quat = np.empty((COUNT, len(links), 4))
    for i, q in enumerate(qpos):
        robot.update_cfg(dict(zip(joints, q, strict=True)))
        for j, link in enumerate(links):
            pose = np.asarray(robot.get_transform(link, base), dtype=np.float64)
            pos[i, j] = pose[:3, 3]
            quat[i, j] = quaternion_from_matrix(pose)  # w, x, y, z

    out = Path(__file__).with_name(f"{args.name}_fk.npz")
    np.savez_compressed(out, joints=joints, links=links, qpos=qpos, pos=pos, quat=quat)
    print(f"{out.name}: {COUNT} vectors, {len(joints)} joints, {len(links)} links")


if __name__ == "__main__":
    main()
