"""Camera images as thumbnails for the page: JPEG, in base64."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Mapping
from pathlib import Path

from data_tools.datasets.source import Images
from data_tools.files.isolated_reading import isolated

Thumbnails = Mapping[str, list[str | None]]
QUALITY = 60  # of JPEG, in percent


def thumbnails(images: Images, width: int) -> Thumbnails:
    """Return the images of a scene by camera, `width` pixels wide or less. Raises `InputError` for a broken one."""
    return {
        camera: [None if file is None else _isolated(file, width) for file in files] for camera, files in images.items()
    }


def _isolated(file: Path, width: int) -> str:
    return "".join(isolated("expected an image", _thumbnail, file, width))


def _thumbnail(file: Path, width: int) -> Iterator[str]:
    from PIL import Image

    buffer = io.BytesIO()
    with Image.open(file) as image:
        image.draft("RGB", (2 * width, 2 * width))  # JPEG is then decoded at a fraction of its size
        small = image.convert("RGB")
        small.thumbnail((width, width))
        small.save(buffer, "JPEG", quality=QUALITY)
    yield base64.b64encode(buffer.getvalue()).decode("ascii")
