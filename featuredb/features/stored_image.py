"""An image file by its header."""

from dataclasses import KW_ONLY, dataclass


@dataclass(frozen=True, slots=True)
class ImageHeader:
    """Format and size of an image as stored.

    Attributes:
        format: JPEG, PNG, WEBP, TIFF, BMP, HEIC or AVIF.
        width, height: pixels as stored, before EXIF orientation.
        jfif: the JPEG has a JFIF header. Cameras write EXIF in its place (Exif 2.3, 4.5.4: directly after the
            start), programs that save a photo anew write both.
        orientation: 1..8 where the format says it in place of EXIF, or None.
        exif: (start, stop) of the TIFF stream with the EXIF in the file's bytes, or None.
        xmp: (start, stop) of the XMP packet, or None.
        scans: passes over the picture that decoding takes; more than one in progressive JPEGs.
        end: offset after the last byte of the image; cameras append previews and videos behind it.
    """

    format: str
    width: int
    height: int
    _: KW_ONLY
    exif: tuple[int, int] | None = None
    xmp: tuple[int, int] | None = None
    scans: int = 1
    end: int
    orientation: int | None = None
    jfif: bool = False

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.width, self.height
