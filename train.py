"""Trains a policy: python train.py --env nero_lift. See --help."""

from mjx_nero.__main__ import program

if __name__ == "__main__":
    program("train")
