"""Half of a corbelled arch overhangs too far, and stands once its joints pull.

Run: python examples/12_joints_that_pull.py
"""

from __future__ import annotations

from falsework import StabilityOracle, StabilitySettings, load_structure, verify_certificates
from falsework.assembly import Joints, complete_state


def main() -> None:
    """Find out how much tension the joints of a stair of six blocks need."""
    corbel = load_structure("corbel:courses=6,length=0.5")
    state = complete_state(corbel.boundary)
    state[1:-1:2] = 0  # without its other half, which it leans on
    for kilopascals in (0, 1, 3, 10):
        joints = Joints.from_arrays(corbel.contacts, tension=1000.0 * kilopascals)
        glued = corbel.replace(joints=joints)
        verdicts = StabilityOracle(glued).verdicts(state, require_certificate=True)
        assert verify_certificates(glued, state[None], verdicts, StabilitySettings().claim).all()
        print(f"tension {kilopascals} kPa: {'stands' if verdicts.stable[0] else 'falls'}")


if __name__ == "__main__":
    main()
