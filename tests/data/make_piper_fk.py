"""Write piper_fk.npz: reference link poses of the Piper, computed from its URDF with yourdfpy.

    python tests/data/make_piper_fk.py path/to/piper_gripper.urdf

The URDF is the gripper variant named in assets/piper/README.md. Poses are relative to base_link. Meshes are not needed.
"""

import argparse
from pathlib import Path

import numpy as np
import yourdfpy
from trimesh.transformations import quaternion_from_matrix

COUNT = 100
SEED = 0
BASE = "base_link"
OUT = Path(__file__).with_name("piper_fk.npz")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("urdf", type=Path)
    args = parser.parse_args()

    robot = yourdfpy.URDF.load(str(args.urdf), build_scene_graph=True, load_meshes=False)
    joints = robot.actuated_joint_names
    links = [name for name in robot.link_map if name not in ("world", BASE)]
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
            pose = np.asarray(robot.get_transform(link, BASE), dtype=np.float64)
            pos[i, j] = pose[:3, 3]
            quat[i, j] = quaternion_from_matrix(pose)  # w, x, y, z

    np.savez_compressed(OUT, joints=joints, links=links, qpos=qpos, pos=pos, quat=quat)
    print(f"{OUT.name}: {COUNT} vectors, {len(joints)} joints, {len(links)} links")


if __name__ == "__main__":
    main()
