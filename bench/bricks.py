"""Test split of StableText2Brick: from its parquet file to texts of bricks, one for each structure."""

from __future__ import annotations

import re
from pathlib import Path

from bench.structures import BRICKS
from falsework.errors import DependencyError, InputError

_NAME = re.compile(r"[\w-]{1,80}")


def unpack(file: Path, root: Path) -> int:
    """Write the structures of a parquet file below a folder of data; return how many there are.

    Columns are `bricks`, the text, and `structure_id`; without the latter structures are numbered.

    Raises:
        DependencyError: pyarrow is not installed.
        InputError: the file cannot be read, has no bricks, or a name that is not fit for a file.
    """
    try:
        from pyarrow import ArrowException, parquet
    except ImportError:
        raise DependencyError("parquet files need pyarrow; pip install pyarrow") from None
    try:
        columns = parquet.read_table(file).to_pydict()
    except (OSError, ArrowException) as error:
        raise InputError(f"{file} cannot be read as a parquet file: {str(error).splitlines()[0]}") from None
    if "bricks" not in columns:
        raise InputError(f"{file} has no column bricks, but {', '.join(sorted(columns)) or 'none'}; take another file")
    texts = columns["bricks"]
    names = columns.get("structure_id") or [f"{number:06d}" for number in range(len(texts))]
    folder = root / BRICKS
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in zip(names, texts, strict=True):
        if not isinstance(name, str) or not _NAME.fullmatch(name) or not isinstance(text, str):
            raise InputError(f"{file} has a structure {str(name)[:40]!r}, which makes no file of bricks; remove it")
        (folder / f"{name}.txt").write_text(text, encoding="utf-8")
    return len(texts)
