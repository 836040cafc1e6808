"""The exception for errors that the user can correct, and the message for a missing package."""

import sys

EXTRAS = {  # package -> the extra that installs it
    "av": "demos",
    "can": "deploy",
    "cv2": "camera",
    "gymnasium": "gym",
    "lerobot": "lerobot",
    "onnx": "onnx",
    "onnxruntime": "deploy",
    "pupil_apriltags": "camera",
    "pyarrow": "demos",
    "pymodbus": "deploy",
    "serial": "deploy",
    "stable_baselines3": "torch",
    "torch": "torch",
    "viser": "view",
}


class UserError(ValueError):
    """An error that the user can correct. Its message is one line that says what is wrong and what to do.

    Messages quote the contents of files. So control characters, which could control a terminal, are escaped, and a message
    longer than ``LONGEST`` is shortened in its middle.
    """

    LONGEST = 480  # characters

    def __init__(self, message: str):
        text = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(message.split()))
        if len(text) > self.LONGEST:
            text = f"{text[: self.LONGEST - 164]} ... {text[-159:]}"  # the end says what to do
        super().__init__(text)


def missing(error: ModuleNotFoundError) -> str:
    """Returns one line that says what to do about a missing package."""
    package = (error.name or str(error)).partition(".")[0]
    if extra := EXTRAS.get(package):
        return f"this needs {package}, of the extra {extra!r}: pip install 'mjx-nero[{extra}]'"
    return (
        f"{sys.executable} does not have the package {package!r}: activate the environment that mjx_nero was installed into "
        "(. .venv/bin/activate), or install it (pip install -e .)"
    )
