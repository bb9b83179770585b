"""The poses world_from_sensor of a sequence, KITTI's 12 numbers a line, from the ego motions of its pairs.

    poses_of.py [--same POSES] PAIR.npz...

A pair has its ego motion, target_from_source, as ego_SE3 (truth) or ego (an estimate). With --same the poses are
compared with those of a file to a micrometre instead of printed.
"""

import argparse
import sys

import numpy

parser = argparse.ArgumentParser()
parser.add_argument("--same", metavar="POSES")
parser.add_argument("pairs", nargs="+")
arguments = parser.parse_args()

pose = numpy.eye(4)
poses = [pose]
for path in arguments.pairs:
    with numpy.load(path) as pair:
        ego = pair["ego_SE3" if "ego_SE3" in pair else "ego"]
    pose = pose @ numpy.linalg.inv(ego)
    poses.append(pose)
rows = numpy.array([pose[:3].ravel() for pose in poses])
if arguments.same:
    sys.exit(not numpy.allclose(rows, numpy.loadtxt(arguments.same), rtol=0.0, atol=1e-6))
numpy.savetxt(sys.stdout, rows, fmt="%.12f")
