"""Make the pictures of README and documentation, all by the software itself: `make images`."""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("MPLBACKEND", "agg")
HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "pictures"))

import cell_pictures  # noqa: E402
import commands  # noqa: E402
import diagrams  # noqa: E402
import exits  # noqa: E402
import force_torque  # noqa: E402
import scaling  # noqa: E402
import screen  # noqa: E402


def main() -> None:
    """Write every picture, or those whose names are given."""
    folder = HERE / "images"
    folder.mkdir(exist_ok=True)
    pictures = {
        "vault-plan": commands.vault_plan,
        "friction-cone": diagrams.friction_cone,
        "slope": diagrams.slope,
        "two-walls": diagrams.two_walls,
        "equilibrium-plan": commands.equilibrium_plan,
        "press": commands.press,
        "sheet": commands.sheet,
        "arch-stands.svg": commands.arch_that_stands,
        "arch-falls.svg": commands.arch_that_falls,
        "state-graph": commands.state_graph,
        "clear-exits": exits.clear_exits,
        "force-torque-graph": force_torque.force_torque_graph,
        "scaling": scaling.cost_against_parts,
        "planning": scaling.planning_against_parts,
        **{f"gallery-{name}": commands.gallery for name in commands.BUILT_IN},
        **{f"real-{name}": commands.real for name in (*commands.REAL, *commands.PUBLIC)},
        "arch-plan.gif": commands.film,
        "page": screen.page,
        "page-prop": screen.page_with_prop,
        "notebook": screen.notebook,
        "cell": cell_pictures.cell,
        "cell-page": cell_pictures.cell_page,
    }
    for name in sys.argv[1:] or pictures:
        path = folder / (name if "." in name else f"{name}.png")
        pictures[name](path)
        print(path)


if __name__ == "__main__":
    main()
