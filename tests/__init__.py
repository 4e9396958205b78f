"""Tests of the package. README.md says where a test and a helper are."""

import pytest

# A failed assertion of a helper then shows its values, as that of a test does.
pytest.register_assert_rewrite("tests.support")
