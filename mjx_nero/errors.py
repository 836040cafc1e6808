"""The one error that a user is meant to see, and what to say where a package is missing."""

import sys


class UserError(ValueError):
    """A mistake that the user can mend. Its message is one line that says what is wrong and what to do.

    Messages quote what files hold. So control characters, which could speak to a terminal, are escaped, and of a text beyond
    ``LONGEST`` the middle is left out.
    """

    LONGEST = 480  # characters

    def __init__(self, message: str):
        text = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(message.split()))
        if len(text) > self.LONGEST:
            text = f"{text[: self.LONGEST - 164]} ... {text[-159:]}"  # what to do stands at the end
        super().__init__(text)


def missing(error: ModuleNotFoundError) -> str:
    """Writes one line that says what to do about a missing package."""
    package = (error.name or str(error)).partition(".")[0]
    return (
        f"{sys.executable} does not have the package {package!r}: activate the environment that mjx_nero was installed into "
        "(. .venv/bin/activate), or install it (pip install -e .)"
    )
