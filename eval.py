"""Plays and measures a policy or a controller: python eval.py --env nero_lift. See --help."""

from mjx_nero.__main__ import program

if __name__ == "__main__":
    program("eval")
