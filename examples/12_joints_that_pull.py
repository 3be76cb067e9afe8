"""A cantilever of glued blocks: how much tension its joints need.

Run: python examples/12_joints_that_pull.py
"""

from __future__ import annotations

from falsework.assembly import Joints, complete_state, load_structure
from falsework.stability import Stability, verify_certificates


def main() -> None:
    """A corbelled wall whose blocks overhang too far stands once its joints pull."""
    corbel = load_structure("corbel:blocks=6,reach=1.3")
    state = complete_state(corbel.boundary)[None]
    for kilopascals in (0, 2, 5, 20):
        joints = Joints.of(corbel.contacts, tension=1000.0 * kilopascals)
        glued = corbel.replace(joints=joints)
        verdicts = Stability(glued).check(state)
        assert verify_certificates(glued, state, verdicts).all()
        print(f"tension {kilopascals} kPa: {'stands' if verdicts.stable[0] else 'falls'}")


if __name__ == "__main__":
    main()
