"""The errors a user of stereokit can meet, one family.

Each message says what was given, what was expected and what would work. The command line prints the message as
one line and exits with 2.
"""

import os

__all__ = ["CheckpointError", "ConfigError", "InputError", "StereoKitError", "printable"]


_MOST = 400


class StereoKitError(Exception):
    """Base of all errors that stereokit raises on purpose.

    The message is one line of fewer than 400 characters whatever a file or a file's name put into it: control
    characters, and what no terminal can print, are escaped, and of a longer one the middle is left out. What was given
    stands at its beginning, and what to do at its end.

    >>> from stereokit import build_model
    >>> try:
    ...     build_model("coexx")
    ... except StereoKitError as error:
    ...     print(str(error).split(";")[0])
    unknown model 'coexx'
    """

    def __str__(self) -> str:
        text = super().__str__()
        if not text.isprintable():
            text = "".join(sign if sign.isprintable() else repr(sign)[1:-1] for sign in text)
        return text if len(text) < _MOST else f"{text[: _MOST - 164]} ... {text[-158:]}"


class ConfigError(StereoKitError, ValueError):
    """A network that can't be composed: unknown names, unknown arguments, neighbours that do not fit."""


class InputError(StereoKitError, ValueError):
    """Images, tensors or data files that can't be used: unreadable, of the wrong shape, type or range."""


class CheckpointError(StereoKitError, ValueError):
    """Weights that can't be loaded: truncated, of another network, or a pickle that would run code."""


def printable(name: str | bytes | os.PathLike[str], most: int = 120, *, quoted: bool = True) -> str:
    """A file's name, or other words of a user's, as messages show them: on one line, not too long.

    What can't be printed is escaped: control characters, and the bytes of a name that is not UTF-8.

    Args:
        name: a path or any text.
        most: characters, quotes included. Of a longer name the middle is left out.
        quoted: put it in quotes; tables and lists do without.

    >>> printable("left.png"), printable("new" + chr(10) + "line")
    ("'left.png'", "'new\\\\nline'")
    >>> printable("left.png", quoted=False)
    'left.png'
    >>> printable("a/" + "very/" * 100 + "long.png", most=40)
    "'a/very/very/very/...ry/very/long.png'"
    """
    text = repr(os.fspath(name))
    if len(text) > most:
        kept = (most - 3) // 2
        text = f"{text[:kept]}...{text[-kept:]}"
    return text if quoted else text[1:-1]
