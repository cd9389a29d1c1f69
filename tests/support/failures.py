"""What a command gives, and what a failure looks like."""

from collections.abc import Callable

Outcome = tuple[int, str, str]

Cli = Callable[..., Outcome]


def fails(outcome: Outcome, *fragments: str) -> None:
    status, out, err = outcome
    assert status == 2
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    for fragment in fragments:
        assert fragment in err
