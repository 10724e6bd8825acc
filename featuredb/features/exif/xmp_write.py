"""Angles, accuracy and attribution put into a photo's XMP packet, in the words of drones' makers."""

import re
from collections.abc import Mapping
from xml.sax.saxutils import escape

NAMESPACES = {
    "drone-dji": "http://www.dji.com/drone-dji/1.0/",
    "Camera": "http://pix4d.com/camera/1.0/",
    "featuredb": "urn:featuredb:photo:1.0",
}
_END = b"</rdf:RDF>"
_EMPTY = (
    '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n'
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
    '</rdf:RDF></x:xmpmeta>\n<?xpacket end="w"?>'
).encode()


def with_properties(xmp: bytes, properties: Mapping[str, str], stale: tuple[str, ...] = ()) -> bytes:
    """The packet with these simple properties in a description of their own.

    Properties of the same names are taken out first, whether they are attributes or elements, and so are
    those that are `stale`. What cannot be recognised as a packet is replaced as a whole.

    Args:
        xmp: the packet; b"" where there is none.
        properties: by names with their prefixes, such as "drone-dji:GimbalYawDegree"; see NAMESPACES.
    """
    packet = xmp if _END in xmp else _EMPTY
    for name in (*properties, *stale):
        packet = _without(packet, name.encode())
    prefixes = sorted({name.split(":")[0] for name in properties})
    spaces = "".join(f'\n  xmlns:{prefix}="{NAMESPACES[prefix]}"' for prefix in prefixes)
    values = "".join(
        f'\n  {name}="{escape(_clean(value), {chr(34): "&quot;"})}"' for name, value in properties.items()
    )
    mine = f'<rdf:Description rdf:about=""{spaces}{values}/>\n'.encode()
    head, end, tail = packet.rpartition(_END)
    return head + mine + end + tail


def _without(packet: bytes, name: bytes) -> bytes:
    name = re.escape(name)
    # One blank, not a run of them: packets are padded by kilobytes of blanks, and a search for a run would
    # begin anew at each of them.
    packet = re.sub(rb"\s" + name + rb"\s*=\s*(\"[^\"]*\"|'[^']*')", b"", packet)
    return re.sub(rb"<" + name + rb"(\s[^<>]*)?(/>|>[^<]*</" + name + rb"\s*>)\s*", b"", packet)


def _clean(value: str) -> str:
    return "".join(c for c in value if c >= " ")
