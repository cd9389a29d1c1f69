"""What `import estimator` offers, and what it costs."""

import subprocess
import sys

import pytest

import estimator


@pytest.mark.parametrize("name", estimator.__all__)
def test_every_public_name_has_a_docstring(name: str) -> None:
    assert getattr(estimator, name).__doc__


def test_a_name_that_is_not_there_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'gateway'"):
        estimator.gateway  # noqa: B018


def test_the_import_loads_no_numbers_and_no_bus() -> None:
    """`roadload --version` must not wait for them."""
    command = "import sys, estimator; print([name for name in ('numpy', 'can', 'scipy') if name in sys.modules])"
    run = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"
