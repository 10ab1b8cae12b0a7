"""Pictures: the bytes of image files as pixels."""

from __future__ import annotations

import io
import re

from typing import Any

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from .mapping import Look

MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "YCbCr")
"""Pillow's names of the kinds of pixels that have at most 8 bits per channel and become RGB without a choice."""
DEPTHS = ("I", "I;16", "I;16B", "I;16L", "F", "L")
"""Pillow's names of the kinds of pixels that a depth may have."""
DEEP = re.compile(r";16[BLNS]")
"""What Pillow's decoders are told of channels of 16 bits, whose lower half they drop."""


def shown(picture: Any, look: Look) -> np.ndarray:
    """Returns the pixels that are kept of a picture, uint8 [rows, columns, 3] or [rows, columns].

    Args:
        picture: numbers, [rows, columns, channels] or [rows, columns], or the bytes of an image file.
        look: what is done with it.

    Raises:
        ValueError: it is no picture, or one that would lose values. The message goes behind the picture's place.
    """
    pixels = decoded(picture, look.range is not None) if isinstance(picture, bytes) else picture
    if not isinstance(pixels, np.ndarray):
        raise ValueError(
            f"is no picture but {type(picture).__name__}; a picture is uint8, or the bytes of an image file"
        )
    if look.crop:
        top, left, height, width = look.crop
        if top + height > pixels.shape[0] or left + width > pixels.shape[1]:
            raise ValueError(
                f"has {pixels.shape[0]} x {pixels.shape[1]} pixels, and its crop ends at {top + height} x "
                f"{left + width}"
            )
        pixels = pixels[top : top + height, left : left + width]
    if look.range:
        if pixels.ndim != 2:
            raise ValueError("has several channels; only a depth, which has one, has a range")
        low, high = look.range
        share = np.nan_to_num((pixels.astype(np.float64) - low) / (high - low), nan=0.0)
        pixels = np.rint(255 * np.clip(share, 0.0, 1.0)).astype(np.uint8)
    if pixels.dtype != np.uint8:
        raise ValueError(
            f"is no picture but {pixels.dtype}; a picture has 8 bits per channel; give a depth a range, such as "
            "'range: [0.2, 1.5]', of which the ends become 0 and 255"
        )
    return np.ascontiguousarray(pixels[..., 2::-1] if look.is_bgr and pixels.ndim == 3 else pixels)


def decoded(data: bytes, is_depth: bool = False) -> np.ndarray:
    """Returns the pixels of an image file as its viewers show them, uint8 [rows, columns, 3], or the numbers of a
    depth, [rows, columns]. Alpha is left out.

    Raises:
        ValueError: it is no picture, or one that would lose values. The message goes behind the picture's place.
    """
    try:
        with Image.open(io.BytesIO(data)) as image:
            mode, count = image.mode, getattr(image, "n_frames", 1)
            deep = any(DEEP.search(str(tile)) for tile in image.tile)
            # Further pictures of a camera's JPEG are previews of the first.
            is_several = count > 1 and image.format not in ("JPEG", "MPO")
            if is_depth and mode in DEPTHS and not is_several:
                return np.asarray(ImageOps.exif_transpose(image))
            if mode in MODES and not deep and not is_several:
                return np.asarray(ImageOps.exif_transpose(image).convert("RGB"))
    except UnidentifiedImageError:
        raise ValueError("is no picture, or damaged: it does not begin as any image file does") from None
    # Pillow raises many kinds of errors for a damaged file.
    except Exception as error:
        raise ValueError(f"is no picture, or damaged: {error}") from None
    if is_several:
        raise ValueError(f"holds {count} pictures; save each as a file of its own")
    kind = f"{mode} with 16 bits" if mode in MODES else mode
    raise ValueError(
        f"has pixels of the kind {kind}; a picture has 8 bits per channel, in gray, RGB or a palette; give a "
        "depth a range, such as 'range: [200, 1500]', of which the ends become 0 and 255"
    )


def is_file(data: bytes) -> bool:
    """Returns whether data are a whole PNG or JPEG file, not raw pixels."""
    return data.startswith(b"\x89PNG\r\n\x1a\n") or (data.startswith(b"\xff\xd8\xff") and data.endswith(b"\xff\xd9"))
