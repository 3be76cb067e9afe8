"""Make the pictures of README and documentation, all by the software itself: `make images`."""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("MPLBACKEND", "agg")
HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "pictures"))

import arch  # noqa: E402
import diagrams  # noqa: E402
import exits  # noqa: E402
import force_torque  # noqa: E402
import scaling  # noqa: E402
from sheet import plan_of_a_vault  # noqa: E402


def main() -> None:
    """Write every picture, or those whose names are given."""
    folder = HERE / "images"
    folder.mkdir(exist_ok=True)
    pictures = {
        "vault-plan": plan_of_a_vault,
        "friction-cone": diagrams.friction_cone,
        "slope": diagrams.slope,
        "arches": arch.proofs,
        "state-graph": arch.state_graph,
        "clear-exits": exits.clear_exits,
        "force-torque-graph": force_torque.force_torque_graph,
        "scaling": scaling.cost_against_parts,
    }
    for name in sys.argv[1:] or pictures:
        path = folder / f"{name}.png"
        pictures[name](path)
        print(path)


if __name__ == "__main__":
    main()
