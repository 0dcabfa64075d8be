import json

import numpy as np
import pytest
from material_palette.core.errors import PaletteError
from material_palette.core.tensors import read_tensors, write_tensors

TENSORS = {
    "half": np.linspace(-1, 1, 6, dtype=np.float16).reshape(2, 3),
    "mask": np.array([True, False, True]),
    "single": np.arange(4, dtype=np.float32).reshape(1, 4, 1),
    "count": np.array(7, np.int64),
    "none": np.zeros((0, 3), np.float32),
}


def test_round_trip(tmp_path):
    write_tensors(tmp_path / "a.safetensors", TENSORS, {"licence": "CC0 – ü"})
    back, metadata = read_tensors(tmp_path / "a.safetensors")
    assert metadata == {"licence": "CC0 – ü"}
    assert back.keys() == TENSORS.keys()
    for name, array in TENSORS.items():
        assert back[name].dtype == array.dtype
        np.testing.assert_array_equal(back[name], array)


def test_the_library_reads_our_files_and_we_read_its(tmp_path):
    library = pytest.importorskip("safetensors.numpy")
    write_tensors(tmp_path / "ours.safetensors", TENSORS)
    for name, array in library.load_file(tmp_path / "ours.safetensors").items():
        np.testing.assert_array_equal(array, TENSORS[name])
    library.save_file(TENSORS, tmp_path / "theirs.safetensors")
    for name, array in read_tensors(tmp_path / "theirs.safetensors")[0].items():
        np.testing.assert_array_equal(array, TENSORS[name])


def test_same_bytes_again(tmp_path):
    write_tensors(tmp_path / "a", TENSORS)
    write_tensors(tmp_path / "b", dict(reversed(TENSORS.items())))
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize("length", [0, 5, 60, -1])
def test_a_cut_file_is_refused_by_name(tmp_path, length):
    path = tmp_path / "cut.safetensors"
    write_tensors(path, TENSORS)
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(PaletteError, match=r"cut\.safetensors"):
        read_tensors(path)


@pytest.mark.parametrize(
    "entry",
    [
        {"dtype": "F32", "shape": [4], "data_offsets": [0, 8]},
        {"dtype": "F32", "shape": [2], "data_offsets": [8, 16]},
        {"dtype": "F32", "shape": [-1, -2], "data_offsets": [0, 8]},
        {"dtype": "BF16", "shape": [4], "data_offsets": [0, 8]},
        {"shape": [2]},
        [],
    ],
)
def test_a_lying_header_is_refused(tmp_path, entry):
    text = json.dumps({"x": entry}).encode()
    path = tmp_path / "lie.safetensors"
    path.write_bytes(len(text).to_bytes(8, "little") + text + bytes(8))
    with pytest.raises(PaletteError, match=r"lie\.safetensors"):
        read_tensors(path)


def test_missing_file(tmp_path):
    with pytest.raises(PaletteError, match=r"no\.safetensors"):
        read_tensors(tmp_path / "no.safetensors")
