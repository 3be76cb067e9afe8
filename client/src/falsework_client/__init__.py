"""Client of the falsework service: blocks in; verdicts, plans and pictures out."""

from falsework_client.blocks import UNITS, Block, write_folder
from falsework_client.errors import ClientError
from falsework_client.local_service import LocalService
from falsework_client.structure import Plan, Step, Structure, Verdict, shared_structure

__all__ = [
    "UNITS",
    "Block",
    "ClientError",
    "LocalService",
    "Plan",
    "Step",
    "Structure",
    "Verdict",
    "shared_structure",
    "write_folder",
]
