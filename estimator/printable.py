"""Text that is safe to print: names of files and signals may hold anything, control sequences included."""

from unicodedata import category

HIDDEN = {"Cc", "Cf", "Cs", "Zl", "Zp"}  # Unicode categories: controls, formats, lone surrogates, line separators


def escaped(text: str) -> str:
    """The text with bytes escaped that are no UTF-8, as names of files may have."""
    return text.encode("utf-8", "backslashreplace").decode()


def printable(text: str) -> str:
    """The text with all characters escaped that a terminal would obey or could not show."""
    return "".join(c.encode("unicode_escape").decode() if category(c) in HIDDEN else c for c in text)
