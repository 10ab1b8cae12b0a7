"""Pictures: the bytes of image files as pixels."""

from __future__ import annotations

import io
import re

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "YCbCr")
"""Pillow's names of the kinds of pixels that have at most 8 bits per channel and become RGB without a choice."""
DEEP = re.compile(r";16[BLNS]")
"""What Pillow's decoders are told of channels of 16 bits, whose lower half they drop."""


def decoded(data: bytes) -> np.ndarray:
    """Returns the pixels of an image file as its viewers show them, uint8 [rows, columns, 3]. Alpha is left out.

    Raises:
        ValueError: it is no picture, or one that would lose values. The message goes behind the picture's place.
    """
    try:
        with Image.open(io.BytesIO(data)) as image:
            mode, count = image.mode, getattr(image, "n_frames", 1)
            deep = any(DEEP.search(str(tile)) for tile in image.tile)
            # Further pictures of a camera's JPEG are previews of the first.
            is_several = count > 1 and image.format not in ("JPEG", "MPO")
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
        f"has pixels of the kind {kind}; a picture has 8 bits per channel, in gray, RGB or a palette; convert it "
        "before the import, depths with a fixed range, so that 0 and 255 mean the same in all"
    )


def is_file(data: bytes) -> bool:
    """Returns whether data are a whole PNG or JPEG file, not raw pixels."""
    return data.startswith(b"\x89PNG\r\n\x1a\n") or (data.startswith(b"\xff\xd8\xff") and data.endswith(b"\xff\xd9"))
