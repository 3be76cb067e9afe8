"""Digests for the files in which numba caches compiled functions.

Numba unpickles these files and runs their code as they are: a file that a power cut has left empty ends every command
with an exception, one with a changed bit perhaps without. Files with a digest are other files than numba's own.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba.core.caching import IndexDataCacheFile

from falsework.errors import InputError
from falsework.utils.cache.folder import cache_folder, read_sealed, warn_of_no_cache, write_sealed


class SealedCacheFile(IndexDataCacheFile):
    """Index and data files of one function, each after its digest."""

    @classmethod
    def replace_in(cls, dispatcher: Any, digest: Callable[[], str]) -> None:
        """Make a function of numba that caches itself use such files, in the user's cache.

        Args:
            digest: digest of all sources of its code; another clone with the same ones finds it.
        """
        cache = dispatcher._cache
        plain = getattr(cache, "_cache_file", None)  # none where nothing is cached
        if plain is not None:
            stamp = digest()
            base = f"{plain._index_name.removesuffix('.nbi')}-{stamp[:24]}"
            cache._cache_file = cls(str(cache_folder() / "numba"), base, stamp)

    def save(self, key: Any, data: Any) -> None:
        """Keep the code of one combination of types, where there is room."""
        try:
            Path(self._cache_path).mkdir(parents=True, exist_ok=True)
            super().save(key, data)
        except (OSError, InputError):
            warn_of_no_cache(self._cache_path)

    def _load_index(self) -> dict[Any, str]:
        content = read_sealed(Path(self._index_path))
        if content is None:
            return {}
        version, rest = pickle.loads(content)
        if version != self._version:  # what follows may need that version to be read
            return {}
        stamp, overloads = pickle.loads(rest)
        return overloads if stamp == self._source_stamp else {}

    def _save_index(self, overloads: dict[Any, str]) -> None:
        rest = self._dump((self._source_stamp, overloads))
        write_sealed(Path(self._index_path), pickle.dumps((self._version, rest)))

    def _load_data(self, name: str) -> Any:
        content = read_sealed(Path(self._data_path(name)))
        if content is None:
            raise OSError(f"{name} is gone or damaged")  # numba then compiles anew
        return pickle.loads(content)

    def _save_data(self, name: str, data: Any) -> None:
        write_sealed(Path(self._data_path(name)), self._dump(data))
