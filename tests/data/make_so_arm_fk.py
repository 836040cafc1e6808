"""Write so_arm_fk.npz: reference link poses of the SO-ARM100 and SO-ARM101, computed from their URDFs with yourdfpy.

    python tests/data/make_so_arm_fk.py path/to/so_arm100.urdf path/to/so_arm101.urdf

The URDFs are those named in assets/so_arm100/README.md. Poses are relative to the base link, so the mount does not enter.
Meshes are not needed.
"""

import argparse
from pathlib import Path

import numpy as np
import yourdfpy
from trimesh.transformations import quaternion_from_matrix

COUNT = 50
SEED = 0
OUT = Path(__file__).with_name("so_arm_fk.npz")


def poses(urdf: Path) -> dict[str, np.ndarray]:
    robot = yourdfpy.URDF.load(str(urdf), build_scene_graph=True, load_meshes=False)
    joints = robot.actuated_joint_names
    links = [name for name in robot.link_map if name != robot.base_link]
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
            pose = np.asarray(robot.get_transform(link, robot.base_link), dtype=np.float64)
            pos[i, j] = pose[:3, 3]
            quat[i, j] = quaternion_from_matrix(pose)  # w, x, y, z
    return {"joints": np.array(joints), "links": np.array(links), "qpos": qpos, "pos": pos, "quat": quat}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("so_arm100", type=Path)
    parser.add_argument("so_arm101", type=Path)
    args = parser.parse_args()
    arrays = {f"{name}_{key}": array for name, urdf in vars(args).items() for key, array in poses(urdf).items()}
    np.savez_compressed(OUT, **arrays)
    print(f"{OUT.name}: {COUNT} vectors a robot")


if __name__ == "__main__":
    main()
