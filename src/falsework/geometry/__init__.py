"""Meshes in, numbers out: masses, contacts, clearance. Knows nothing of stability."""

from falsework.geometry.clearance.table import ClearanceTable, clearance_table
from falsework.geometry.contact.interfaces import Contacts, ContactSettings, find_contacts
from falsework.geometry.mesh.mesh import MassProperties, TriangleMesh, mass_properties
from falsework.geometry.mesh.read import load_meshes
from falsework.geometry.mesh.repair import RepairWarning, check_mesh

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
