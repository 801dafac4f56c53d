"""Colour maps and the conversions between display (sRGB) and linear colours."""

import functools

import numpy as np
import numpy.typing as npt

__all__ = ["COLOR_TABLE", "color_table", "hex_tables", "map_colors", "to_linear", "to_srgb"]

# 33 sRGB entries from dark violet over teal to yellow. The hues are those of the viridis family; the entries
# were re-spaced so that CIELAB lightness rises by 1.9 to 2.8 per entry and the OKLab distance of neighbours
# stays within 15 % of its mean. A test checks both.
_HEX_COLORS = (
    "440154 460c5f 471669 482072 482a79 46337f 443d83 404687 3c4f8b 38588d 35608d "
    "31688e 2d718f 2a798f 27818e 23898d 20918c 1e988b 20a088 21a884 25af80 33b67a "
    "45bd72 55c369 64c95f 73cf55 86d449 9ad93b aedd2f c1e127 d5e420 e9e61e fde725"
)
# cividis: Nunez, Anderton and Renslow 2018; coolwarm: Moreland 2009; by their usual tables
_OTHER_HEX_COLORS = {
    "cividis": (
        "00224e 00285b 002e6a 053371 1a386f 273e6e 32436d 3b496c 434e6c 4b546c 535a6d "
        "5a5f6e 61656f 686a71 6f7073 767676 7d7c78 848279 8c8878 938e78 9b9476 a39a74 "
        "aba072 b4a76f bcae6c c4b468 cdbb63 d5c25e dec958 e7d150 f0d846 f9e03a fee838"
    ),
    "coolwarm": (
        "3b4cc0 445acc 4e68d8 5875e1 6282ea 6c8ff1 779af7 82a6fb 8db0fe 98b9ff a3c2fe "
        "aec9fc b9d0f9 c3d5f4 ccd9ed d5dbe5 dddcdc e5d8d1 ecd3c5 f1ccb8 f5c4ac f7ba9f "
        "f7b093 f6a586 f4987a f08b6e eb7d62 e46e56 dd5f4b d44e41 ca3b37 be242e b40426"
    ),
}


def hex_tables() -> dict[str, str]:
    """33 colours of each map from low to high, as six hexadecimal digits, by name."""
    return {"viridis": _HEX_COLORS, **_OTHER_HEX_COLORS}


@functools.cache
def color_table(name: str) -> npt.NDArray[np.float64]:
    """(33, 3) sRGB components of a map of `hex_tables`."""
    entries = hex_tables()[name].split()
    return np.array([[int(entry[k : k + 2], 16) / 255.0 for k in (0, 2, 4)] for entry in entries])


COLOR_TABLE = color_table("viridis")
"""(33, 3) sRGB components in [0, 1]."""


def to_linear(srgb: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Linear light of sRGB components in [0, 1], any shape."""
    c = np.asarray(srgb, dtype=np.float64)
    return np.where(c <= 0.04045, c / 12.92, ((np.maximum(c, 0.0) + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """sRGB components in [0, 1] of linear light; values outside [0, 1] are clipped. Any shape."""
    c = np.clip(np.asarray(linear, dtype=np.float64), 0.0, 1.0)
    return np.where(c <= 0.0031308, c * 12.92, 1.055 * c ** (1.0 / 2.4) - 0.055)


def map_colors(
    values: npt.ArrayLike, low: float, high: float, name: str = "viridis", *, linear: bool = False
) -> npt.NDArray[np.float32]:
    """Colours (..., 3) of scalars (...) by a map: of viridis `low` and below is dark violet, `high` and above yellow.

    An empty range (low = high) gives the lowest colour, a non-finite value mid grey. The table is interpolated in
    sRGB; `linear=True` returns linear light, as required by USD's displayColor.
    """
    v = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(v)
    span = float(high) - float(low)
    t = (np.where(finite, v, low) - low) / span if span > 0.0 else np.zeros_like(v)
    table = color_table(name)
    t = np.clip(t, 0.0, 1.0) * (len(table) - 1)
    index = np.minimum(t.astype(np.intp), len(table) - 2)
    weight = (t - index)[..., None]
    rgb = table[index] * (1.0 - weight) + table[index + 1] * weight
    rgb = np.where(finite[..., None], rgb, 0.5)
    return np.asarray(to_linear(rgb) if linear else rgb, dtype=np.float32)
