"""Decoded pictures of libav to grey and colour arrays: made smaller, of full range, turned upright.

Most films store luma as a plane of its own, 8 bits a pixel, so grey is that plane: a copy of it takes 0.6 ms
at 3840x2160 on one core, libav's own conversion to grey 3.7 ms, and that comes out one level too dark where
the film is of full range already. Luma of limited range (16 to 235) is stretched by a table. Libav's scaler
makes the plane smaller, by areas: ten times as fast as OpenCV's unless the ratio is a whole number, and free
of aliases. Other formats (10 bits, packed, RGB) go through libav's conversion.

A phone held upright stores its pictures as its sensor reads them, lying on their side, and beside them a
matrix that says how to show them (ISO 14496-12, the `matrix` of `tkhd` and `mvhd`). Decoders leave the
pictures as they are. Features, cameras and poses of a film belong to the upright pictures.
"""

import math
import struct
from dataclasses import dataclass, field
from typing import Any, cast

import av
import cv2
import numpy as np
from av.video.reformatter import ColorRange, Colorspace, Interpolation, VideoReformatter
from numpy.typing import NDArray

from featuredb.errors import VideoError

_MATRIX = struct.Struct("=9i")  # 16.16 fixed point but for the last column, in host order as libav keeps it
_ONE = 65536.0
# Writers round the sines of 90 degrees to 16.16; what is further off is meant to be another angle.
_MAX_OFF_DEG = 0.5
_TURNS = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}


def clockwise_from_display_matrix(matrix: bytes | None, name: str) -> int:
    """Degrees, 0, 90, 180 or 270, by which stored pictures are turned clockwise to stand upright.

    The matrix (a b u; c d v; x y w) takes the stored point (p, q), y down, to (a p + c q + x, b p + d q + y)
    on the screen. What it shifts or scales is of no interest: only where its axes point.

    Args:
        matrix: the side data DISPLAYMATRIX, 36 bytes, or None for a film without one.

    Raises:
        VideoError: another angle, a mirrored picture, or no matrix of that size.
    """
    if matrix is None:
        return 0
    if len(matrix) != _MATRIX.size:
        raise VideoError(f"{name}: expected a display matrix of {_MATRIX.size} bytes, found {len(matrix)}")
    a, b, _, c, d, *_ = (value / _ONE for value in _MATRIX.unpack(matrix))
    determinant = a * d - b * c
    if determinant == 0.0:
        raise VideoError(
            f"{name}: the display matrix ({a:g} {b:g}; {c:g} {d:g}) shows no picture; encode the film again"
        )
    if determinant < 0.0:
        raise VideoError(
            f"{name}: the display matrix mirrors the picture (as of a selfie camera), and scenes would come "
            "out mirrored; switch mirroring off in the camera, or encode the film again as it is to be read"
        )
    angles = (math.degrees(math.atan2(b, a)), math.degrees(math.atan2(-c, d)))
    turns = round(angles[0] / 90.0)
    if any(abs(math.remainder(angle - 90.0 * turns, 360.0)) > _MAX_OFF_DEG for angle in angles):
        raise VideoError(
            f"{name}: the display matrix turns the picture by {angles[0] % 360.0:.1f} degrees, "
            "expected 0, 90, 180 or 270; encode the film again without that rotation"
        )
    return turns % 4 * 90


def turned(picture: NDArray[np.uint8], clockwise_deg: int) -> NDArray[np.uint8]:
    """The picture (h, w) or (h, w, 3) uint8 turned clockwise by 0, 90, 180 or 270 degrees."""
    if clockwise_deg == 0:
        return picture
    # OpenCV turns in blocks that stay in the cache: eight times as fast as a copy of numpy's rot90 at 4K.
    return np.asarray(cv2.rotate(picture, _TURNS[clockwise_deg]), dtype=np.uint8)


# AVColorSpace of the matrices that libav's scaler knows: BT.709, FCC, BT.601 (twice), SMPTE 240M, BT.2020.
_NAMED_MATRICES = frozenset({1, 4, 5, 6, 7, 9, 10})
# By the players' convention a film that names none of them is BT.709 from this height on, else BT.601.
_HD_HEIGHT = 720
# Formats whose plane 0 is luma, one byte a pixel. "yuvj" ones are of full range whatever their tag says.
_FULL_RANGE = frozenset({"yuvj420p", "yuvj422p", "yuvj444p", "yuvj440p", "gray"})
_LUMA_PLANE = _FULL_RANGE | {"yuv420p", "yuv422p", "yuv444p", "yuv440p", "yuv410p", "yuv411p", "nv12", "nv21"}
_FULL_FROM_LIMITED = np.clip(np.rint((np.arange(256) - 16) * (255.0 / 219.0)), 0, 255).astype(np.uint8)


@dataclass(frozen=True, slots=True, kw_only=True)
class PixelReader:
    """Makes arrays of the pictures of one film; greys and colours each from one thread at a time.

    Attributes:
        width, height: of the result before it is turned, pixels.
        clockwise_deg: 0, 90, 180 or 270.
    """

    width: int
    height: int
    clockwise_deg: int
    # Each keeps its scaler set up for one kind of work; a picture's own one would be set up for each picture.
    _gray: VideoReformatter = field(default_factory=VideoReformatter, repr=False)
    _gray_yuv: VideoReformatter = field(default_factory=VideoReformatter, repr=False)
    _rgb_yuv: VideoReformatter = field(default_factory=VideoReformatter, repr=False)
    _rgb: VideoReformatter = field(default_factory=VideoReformatter, repr=False)

    def gray(self, picture: av.VideoFrame) -> NDArray[np.uint8]:
        """Grey (h, w) uint8 of full range, upright; owns its memory.

        Raises:
            av.FFmpegError: libav cannot convert this format.
        """
        name = picture.format.name
        if name not in _LUMA_PLANE and picture.format.components[0].is_luma:
            # Libav's own grey of these would weigh the colours anew by BT.601, whatever the film's matrix.
            matrix = _matrix(picture)
            name = "yuv420p"
            picture = self._scaled(
                self._gray_yuv, picture, name, src_colorspace=matrix, dst_colorspace=matrix
            )
        if name in _LUMA_PLANE and picture.planes[0].line_size >= picture.width:
            gray = self._luma(picture)
            if name not in _FULL_RANGE and picture.color_range != ColorRange.JPEG:
                gray = np.asarray(cv2.LUT(gray, _FULL_FROM_LIMITED), dtype=np.uint8)
        else:
            gray = self._gray_of(picture)
        # A copy, unless turning or the table made one: the decoder goes on with the plane as its reference.
        return np.require(turned(gray, self.clockwise_deg), requirements=["C", "O"])

    def rgb(self, picture: av.VideoFrame) -> NDArray[np.uint8]:
        """Colours (h, w, 3) uint8 of full range, red first, upright; owns its memory.

        Raises:
            av.FFmpegError: libav cannot convert this format.
        """
        matrix = _matrix(picture)
        if picture.format.name in _LUMA_PLANE:  # smaller first, which leaves less to convert: 3 times as fast
            picture = self._scaled(self._rgb_yuv, picture, None, src_colorspace=matrix, dst_colorspace=matrix)
        rgb = self._scaled(
            self._rgb, picture, "rgb24", src_colorspace=matrix, dst_color_range=ColorRange.JPEG
        )
        pixels = np.asarray(rgb.to_ndarray(), dtype=np.uint8)
        return np.ascontiguousarray(turned(pixels, self.clockwise_deg))

    def _luma(self, picture: av.VideoFrame) -> NDArray[np.uint8]:
        """The luma plane as stored, made smaller; not a copy where the size stays."""
        plane = picture.planes[0]
        # Typed as no buffer, though it is one; the array keeps the picture, and with it the memory, alive.
        rows = np.frombuffer(cast("Any", plane), np.uint8).reshape(picture.height, plane.line_size)
        luma = rows[:, : picture.width]
        if (picture.width, picture.height) == (self.width, self.height):
            return luma
        return self._gray_of(av.VideoFrame.from_numpy_buffer(luma, "gray"))

    def _gray_of(self, picture: av.VideoFrame) -> NDArray[np.uint8]:
        gray = self._scaled(self._gray, picture, "gray", dst_color_range=ColorRange.JPEG)
        return np.asarray(gray.to_ndarray(), dtype=np.uint8)

    def _scaled(
        self, reformatter: VideoReformatter, picture: av.VideoFrame, pixel_format: str | None, **colours: Any
    ) -> av.VideoFrame:
        """The picture in its final size and another format."""
        return reformatter.reformat(
            picture,
            self.width,
            self.height,
            pixel_format,
            interpolation=Interpolation.AREA,
            # libav's default of one for each core takes three times as long on two busy cores.
            threads=1,
            **colours,
        )


def _matrix(picture: av.VideoFrame) -> Colorspace | None:
    """The matrix to take for a film that names none; None for one that does, and for RGB."""
    if not picture.format.components[0].is_luma or picture.colorspace in _NAMED_MATRICES:
        return None
    return Colorspace.ITU709 if picture.height >= _HD_HEIGHT else Colorspace.ITU601
