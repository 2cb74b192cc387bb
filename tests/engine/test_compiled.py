"""Compiled code is kept on disk; it must not outlive the sources it was made from."""

from __future__ import annotations

from pathlib import Path

import pytest

from surgbench.compiled import compiled, sources
from surgbench.errors import ConfigError
from surgbench.silhouette import boundary, contour, kernel, spans


def test_compiled_code_is_bound_to_the_whole_packages_sources() -> None:
    """Numba alone looks at the function's own file: an old caller would go on with what it has swallowed."""
    expected = sources((Path(kernel.__file__).parent,))
    for function in (kernel.score, kernel.gradient, contour.trace, spans.cover, boundary.find_boundary):
        assert function._cache._cache_file._source_stamp == expected


def test_a_package_that_is_not_there_is_no_dependency() -> None:
    """A hash of nothing never changes: what was compiled would be kept whatever it calls."""
    with pytest.raises(ConfigError, match="veiwpoint: holds no modules"):
        compiled(calls="veiwpoint")(lambda value: 2 * value)
