"""Text that is safe to print: names of files and signals may hold anything, control sequences included."""

from unicodedata import category

HIDDEN = {"Cc", "Cf", "Cs", "Zl", "Zp"}  # Unicode categories: controls, formats, lone surrogates, line separators


def printable(text: str) -> str:
    """The text with all characters escaped that a terminal would obey or could not show."""
    return "".join(c.encode("unicode_escape").decode() if category(c) in HIDDEN else c for c in text)
