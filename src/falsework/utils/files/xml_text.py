"""XML files with prefixes that they do not declare, which parsers of XML refuse, such as `drake:acceleration`."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from falsework.utils.files.input_file import read_content

_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_PREFIX = re.compile(r"""(?:</?|\s)([A-Za-z_][\w.-]*):[A-Za-z_][\w.-]*(?=[\s=/>])""")
_QUOTED = re.compile(r""""[^"]*"|'[^']*'""")
_ROOT = re.compile(r"<([A-Za-z_][\w:.-]*)")


def read_xml_text(file: Path) -> bytes:
    """Return the content of an XML file in which every prefix is declared, those that were not with a name of ours."""
    content = read_content(file)
    try:
        ElementTree.fromstring(content)
    except ElementTree.ParseError as error:
        if "unbound prefix" not in str(error):
            return content
    else:
        return content
    text = content.decode("utf-8", "surrogateescape")
    plain = _COMMENT.sub("", text)
    root = _ROOT.search(plain)
    if root is None:
        return content
    declared = set(re.findall(r"xmlns:([\w.-]+)\s*=", plain)) | {"xml", "xmlns"}
    used = dict.fromkeys(_PREFIX.findall(_QUOTED.sub('""', plain)))
    added = "".join(f' xmlns:{prefix}="urn:undeclared:{prefix}"' for prefix in used if prefix not in declared)
    # The first opening tag outside comments is also the first one in the text that is not in a comment before it.
    at = next(
        found.end()
        for found in _ROOT.finditer(text)
        if not any(comment.start() < found.start() < comment.end() for comment in _COMMENT.finditer(text))
    )
    return (text[:at] + added + text[at:]).encode("utf-8", "surrogateescape")
