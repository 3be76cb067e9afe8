"""Tables of README, documentation and RESULTS.md from `benchmarks/results/*.jsonl`: `make results`.

    python benchmarks/tables.py            # fill every block
    python benchmarks/tables.py --list     # names of the tables

A page holds a table between `<!-- results: NAME -->` and `<!-- /results -->`. A row gathers the runs of one subject at
the newest commit that has them: the median over runs, with the range in brackets. Numbers have three digits,
from 10 on four, percentages two decimals.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from readme_tables import README_TABLES
from table_list import TABLES
from table_model import REPOSITORY

DOCS = REPOSITORY / "docs"
PAGES = (
    REPOSITORY / "README.md",
    REPOSITORY / "benchmarks" / "RESULTS.md",
    *sorted(path for path in DOCS.rglob("*.md") if not path.relative_to(DOCS).parts[0].startswith("_")),
)
BLOCK = re.compile(r"(<!-- results: ([\w-]+) -->\n).*?(<!-- /results -->)", re.DOTALL)


def table(name: str, page: Path) -> str:
    """Return a table by its name."""
    if name in README_TABLES:
        return README_TABLES[name](page)
    if name not in TABLES:
        raise SystemExit(f"{page}: there is no table {name}; give one of {', '.join([*README_TABLES, *TABLES])}")
    return TABLES[name].text(page)


def filled(page: Path) -> str:
    """Return the text of a page with every block generated again."""
    text = page.read_text(encoding="utf-8")
    return BLOCK.sub(lambda block: f"{block[1]}{table(block[2], page)}\n{block[3]}", text)


def main() -> None:
    """Fill the blocks of all pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="print the names of the tables")
    if parser.parse_args().list:
        print("\n".join([*README_TABLES, *TABLES]))
        return
    for page in PAGES:
        text = filled(page)
        if text != page.read_text(encoding="utf-8"):
            page.write_text(text, encoding="utf-8")
            print(page.relative_to(REPOSITORY))


if __name__ == "__main__":
    main()
