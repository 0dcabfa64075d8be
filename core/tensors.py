"""Tensors in files, safetensors format: read and written here in numpy, since Blender's Python lacks the library.

A file is 8 bytes little endian, the length of a JSON header; the header, name -> dtype, shape, data_offsets; the data.
Source: the format's description in https://github.com/huggingface/safetensors. Nothing in a file is ever executed.
"""

import json
import math
from pathlib import Path

import numpy as np

from .errors import PaletteError

DTYPES = {
    "BOOL": np.bool_,
    "U8": np.uint8,
    "I16": np.int16,
    "I32": np.int32,
    "I64": np.int64,
    "F16": np.float16,
    "F32": np.float32,
    "F64": np.float64,
}
NAMES = {np.dtype(dtype): name for name, dtype in DTYPES.items()}
LONGEST_HEADER = 100_000_000  # bytes, the format's own limit


def write_tensors(path: Path, tensors: dict[str, np.ndarray], metadata: dict[str, str] | None = None) -> None:
    """Write arrays of the types in DTYPES; the same arrays give the same bytes."""
    header: dict[str, dict] = {"__metadata__": metadata} if metadata else {}
    # the format wants aligned data: the widest types first
    arrays = sorted(tensors.items(), key=lambda item: (-np.asarray(item[1]).itemsize, item[0]))
    end = 0
    for name, array in arrays:
        array = np.asarray(array)
        if array.dtype not in NAMES:
            raise TypeError(f"tensor '{name}' has dtype {array.dtype}; the file holds {', '.join(DTYPES)}")
        start, end = end, end + array.nbytes
        header[name] = {"dtype": NAMES[array.dtype], "shape": list(array.shape), "data_offsets": [start, end]}
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    with Path(path).open("wb") as file:
        file.write(len(text).to_bytes(8, "little"))
        file.write(text)
        for _, array in arrays:
            file.write(np.ascontiguousarray(array).tobytes())


def read_tensors(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Arrays by name, and the metadata. Raises PaletteError naming the file when it is missing or damaged."""
    path = Path(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise PaletteError(f"cannot read '{path}': {error.strerror or error}") from error
    try:
        length = int.from_bytes(content[:8], "little")
        if not 2 <= length <= min(LONGEST_HEADER, len(content) - 8):
            raise ValueError("its header is longer than the file")
        header = json.loads(content[8 : 8 + length].decode("utf-8"))
        metadata = header.pop("__metadata__", {})
        tensors = {}
        for name, entry in header.items():
            if entry["dtype"] not in DTYPES:
                raise ValueError(f"tensor '{name}' has the unknown type {entry['dtype']}")
            dtype, shape = np.dtype(DTYPES[entry["dtype"]]), tuple(entry["shape"])
            start, end = entry["data_offsets"]
            if min(shape, default=0) < 0 or not 0 <= start <= end <= len(content) - 8 - length:
                raise ValueError(f"tensor '{name}' lies outside the file")
            if end - start != math.prod(shape) * dtype.itemsize:
                raise ValueError(f"tensor '{name}' has another size than its shape")
            tensors[name] = np.frombuffer(content, dtype, math.prod(shape), 8 + length + start).reshape(shape).copy()
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise PaletteError(f"'{path}' is not a whole safetensors file ({error}); copy or download it again") from error
    return tensors, metadata
