"""Small files that cost much: pictures of many pixels, and of many passes over them."""

import struct
import zlib


def png(width: int, height: int, pixels: bytes, *, bits: int = 8, colour: int = 0) -> bytes:
    """A PNG with this header and these pixels, compressed as `zeros` are, all check sums right."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    return b"".join(
        [b"\x89PNG\r\n\x1a\n", chunk(b"IHDR", header), chunk(b"IDAT", pixels), chunk(b"IEND", b"")]
    )


def zeros(size: int) -> bytes:
    """At least so many bytes 0, as zlib packs them: a block again and again."""
    block = bytes(1 << 20)
    packer = zlib.compressobj(9)
    head = packer.compress(block) + packer.flush(zlib.Z_FULL_FLUSH)
    again = packer.compress(block) + packer.flush(zlib.Z_FULL_FLUSH)
    count = -(-size // len(block))
    # Adler's sums of bytes 0: the first stays 1, the second counts them.
    total = (count * len(block) % 65_521) << 16 | 1
    return head + (count - 1) * again + b"\x03\x00" + struct.pack(">I", total)


def progressive_jpeg(side: int, scans: int) -> bytes:
    """A grey progressive JPEG of side x side pixels (a multiple of 32) with so many scans (2 to 127).

    The first scan has a bit for each block, the others a few for all of them; each is a pass over all.
    """
    blocks = (side // 8) ** 2

    def segment(marker: int, body: bytes) -> bytes:
        return struct.pack(">BBH", 0xFF, marker, 2 + len(body)) + body

    def huffman(kind: int, symbol: int) -> bytes:
        return segment(0xC4, bytes([kind << 4, 1, *[0] * 15, symbol]))  # its only code is the bit 0

    def scan(first: int, last: int, approximation: int, bits: int) -> bytes:
        return segment(0xDA, bytes([1, 1, 0, first, last, approximation])) + bytes(-(-bits // 8))

    out = [b"\xff\xd8", segment(0xDB, bytes([0, *[1] * 64]))]
    out.append(segment(0xC2, struct.pack(">BHHB", 8, side, side, 1) + bytes([1, 0x11, 0])))
    out += [huffman(0, 0x00), huffman(1, 0xE0)]  # no difference; nothing in the next 16,384 blocks
    out.append(scan(0, 0, 0x00, blocks))
    for number in range(scans - 1):
        coefficient = 1 + number % 63
        out.append(scan(coefficient, coefficient, 0x01 if number < 63 else 0x10, 15 * -(-blocks // 16_384)))
    return b"".join(out) + b"\xff\xd9"
