"""Extras of the package: what a message says where a library of one is missing."""


def how_to_install(extra: str) -> str:
    """The command that adds an extra to an installed package, and the one for a clone; quotes suit every shell."""
    return f'pip install "roadload[{extra}]", in a clone .venv/bin/pip install -e ".[{extra}]"'
