"""Meshes in, numbers out: masses, contacts, clearance. Knows nothing of stability."""

from falsework.geometry.clearance import ClearanceTable, clearance_table
from falsework.geometry.contact import Contacts, ContactSettings, find_contacts
from falsework.geometry.mesh import MassProperties, TriangleMesh, mass_properties
from falsework.geometry.read import load_meshes
from falsework.geometry.repair import RepairWarning, check_mesh

__all__ = [
    "ClearanceTable",
    "ContactSettings",
    "Contacts",
    "MassProperties",
    "RepairWarning",
    "TriangleMesh",
    "check_mesh",
    "clearance_table",
    "find_contacts",
    "load_meshes",
    "mass_properties",
]
