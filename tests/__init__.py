"""Tests of the package; README.md lists where tests and helpers are."""

import pytest

# Failed assertions in helpers then show their values, as assertions in tests do.
pytest.register_assert_rewrite("tests.support")
