"""An output folder holds either the whole new palette or exactly what it held before."""

import errno
import json
import os
import shutil
import subprocess

import pytest
from material_palette.core import output
from material_palette.core.errors import Cancelled, PaletteError
from material_palette.core.output import staged


def write_palette(folder, names, text="new"):
    (folder / "masks").mkdir()
    for name in names:
        (folder / name).mkdir()
        (folder / "masks" / f"{name}.png").write_text(text)
        for file in ("basecolor.png", "normal.png"):
            (folder / name / f"{name}_{file}").write_text(text)
        (folder / name / f"{name}.json").write_text(text)
    records = [{"name": n, "maps": {"basecolor": {"file": f"{n}/{n}_basecolor.png"}}} for n in names]
    (folder / "palette.json").write_text(json.dumps({"version": 1, "photo": text, "materials": records}))
    (folder / "palette.png").write_text(text)
    (folder / "palette.blend").write_text(text)


def content(folder):
    """Every path below a folder, with the text of files."""
    return {str(p.relative_to(folder)): p.read_text() if p.is_file() else None for p in folder.rglob("*")}


@pytest.fixture
def palette(tmp_path):
    """A folder with a palette of two materials, and files of the user's beside them."""
    folder = tmp_path / "out"
    folder.mkdir()
    write_palette(folder, ["stone", "wood"], "old")
    (folder / "notes.txt").write_text("mine")
    (folder / "stone" / "stone_painted.png").write_text("mine")
    (folder / "masks" / "extra.png").write_text("mine")
    return folder


@pytest.mark.parametrize("target", ["out", "a/b/out", "empty", "seen"])
def test_missing_and_empty_folders_are_filled(tmp_path, target):
    (tmp_path / "empty").mkdir()
    (tmp_path / "seen").mkdir()
    (tmp_path / "seen" / ".DS_Store").write_text("")
    folder = tmp_path / target
    with staged(folder) as staging:
        assert list(staging.iterdir()) == []
        write_palette(staging, ["stone"])
        assert not (folder / "palette.json").exists()
    expected = tmp_path / "expected"
    expected.mkdir()
    write_palette(expected, ["stone"])
    assert {k: v for k, v in content(folder).items() if k != ".DS_Store"} == content(expected)
    assert {p.name for p in folder.parent.iterdir()} <= {"out", "a", "empty", "seen", "expected"}
    assert folder.stat().st_mode == (tmp_path / "empty").stat().st_mode  # not a private one, as temporary folders are


@pytest.mark.parametrize("error", [ValueError, Cancelled, KeyboardInterrupt, SystemExit, PaletteError])
@pytest.mark.parametrize("target", ["new", "a/b/new", "empty", "out"])
def test_any_end_but_success_leaves_all_as_it_was(tmp_path, palette, error, target):
    (tmp_path / "empty").mkdir()
    before = content(tmp_path)
    with pytest.raises(error), staged(tmp_path / target, overwrite=True) as staging:
        write_palette(staging, ["stone", "moss"])
        raise error("stop")
    assert content(tmp_path) == before


def test_overwriting_replaces_what_the_palette_owns_and_keeps_the_rest(tmp_path, palette):
    with staged(palette, overwrite=True) as staging:
        write_palette(staging, ["moss", "stone"])
    after = content(palette)
    assert {path for path, text in after.items() if text == "old"} == set()
    assert "wood" not in after and "masks/wood.png" not in after
    mine = {"notes.txt", "stone/stone_painted.png", "masks/extra.png"}
    assert {path for path, text in after.items() if text == "mine"} == mine
    assert after["stone/stone_basecolor.png"] == after["moss/moss.json"] == after["masks/moss.png"] == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_old_corners_do_not_stay_beside_new_masks(palette):
    (palette / "masks" / "regions.json").write_text("old")
    with staged(palette, overwrite=True) as staging:
        write_palette(staging, ["moss"])
    assert "masks/regions.json" not in content(palette)


def test_a_mask_painted_beside_the_old_ones_becomes_the_new_palettes(palette):
    """Masks edited in DIR/masks are passed back with --masks DIR/masks -o DIR --overwrite."""
    with staged(palette, overwrite=True) as staging:
        write_palette(staging, ["extra"])
    assert content(palette)["masks/extra.png"] == "new"


def test_a_folder_in_use_needs_overwrite(palette):
    before = content(palette)
    with pytest.raises(PaletteError, match="out' isn't empty. Use --overwrite"), staged(palette):
        pytest.fail("the body ran")
    assert content(palette) == before


@pytest.mark.parametrize("words", [None, "", "{}", "[1]", '{"version": 1}', '{"materials": [3], "version": 1}', "\xff"])
def test_files_that_are_no_palette_are_never_overwritten(tmp_path, words):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.txt").write_text("mine")
    if words is not None:
        (tmp_path / "out" / "palette.json").write_bytes(words.encode("latin-1"))
    with pytest.raises(PaletteError, match="holds files but no palette"), staged(tmp_path / "out", overwrite=True):
        pytest.fail("the body ran")
    assert (tmp_path / "out" / "thesis.txt").read_text() == "mine"


def test_a_users_file_in_the_way_is_named_and_kept(palette):
    (palette / "moss").mkdir()
    (palette / "moss" / "moss_normal.png").write_text("mine")
    before = content(palette)
    with (
        pytest.raises(PaletteError, match="moss_normal.png' is in the way"),
        staged(palette, overwrite=True) as staging,
    ):
        write_palette(staging, ["moss"])
    assert content(palette) == before
    shutil.rmtree(palette / "moss")
    (palette / "moss").write_text("a file where a folder would go")
    before = content(palette)
    with pytest.raises(PaletteError, match="is in the way"), staged(palette, overwrite=True) as staging:
        write_palette(staging, ["moss"])
    assert content(palette) == before


def test_an_edited_palette_json_reaches_no_file_outside(tmp_path, palette):
    (tmp_path / "precious.png").write_text("mine")
    (palette / "other").mkdir()
    (palette / "other" / "precious.png").write_text("mine")
    files = [
        "../precious.png",
        "other/precious.png",
        "/etc/hostname",
        "stone/../notes.txt",
        str(tmp_path / "precious.png"),
    ]
    records = [{"name": "stone", "maps": {str(i): {"file": file} for i, file in enumerate(files)}}]
    records += [{"name": "..", "maps": {}}, {"name": "../..", "maps": {"a": {"file": "../precious.png"}}}]
    (palette / "palette.json").write_text(json.dumps({"version": 1, "materials": records}))
    with staged(palette, overwrite=True) as staging:
        write_palette(staging, ["stone"])
    assert (tmp_path / "precious.png").read_text() == (palette / "other" / "precious.png").read_text() == "mine"
    assert (palette / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("fatal", [OSError(errno.EIO, "Input/output error"), KeyboardInterrupt()])
def test_a_failure_at_any_step_of_the_swap_restores_the_old_palette(tmp_path, palette, monkeypatch, fatal):
    before = content(tmp_path)
    rename, steps, done = os.rename, 0, False
    while not done:
        calls = 0

        def failing(source, destination, at=steps):
            nonlocal calls
            calls += 1
            if calls == at + 1:
                raise fatal
            rename(source, destination)

        monkeypatch.setattr(output.os, "rename", failing)
        try:
            with staged(palette, overwrite=True) as staging:
                write_palette(staging, ["moss", "stone"])
            done = True
        except (OSError, KeyboardInterrupt):
            assert content(tmp_path) == before
            steps += 1
    assert steps > 15  # every file moved was a step


@pytest.mark.parametrize(
    "full", [OSError(errno.ENOSPC, "No space left on device"), RuntimeError("Can't save: No space left on device")]
)
def test_a_full_disk_names_the_folder(tmp_path, full):
    with (
        pytest.raises(PaletteError, match="disk of output folder '.*out' is full"),
        staged(tmp_path / "out") as staging,
    ):
        (staging / "a").write_text("x")
        raise full
    assert list(tmp_path.iterdir()) == []


def test_other_errors_of_the_body_stay_what_they_are(tmp_path):
    with pytest.raises(FileNotFoundError), staged(tmp_path / "out"):
        open(tmp_path / "missing")


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="mounting a small disk needs root")
def test_a_really_full_disk_and_a_mounted_folder(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", disk], capture_output=True).returncode:
        pytest.skip("no small disk can be mounted here")
    try:
        for folder in (disk / "out", disk):  # into a new folder of it, and into the mount point itself
            with pytest.raises(PaletteError, match="is full"), staged(folder) as staging:
                (staging / "big.png").write_bytes(bytes(1 << 20))
            assert list(disk.iterdir()) == []
        with staged(disk) as staging:
            (staging / "palette.json").write_text("fits")
        assert content(disk) == {"palette.json": "fits"}
    finally:
        subprocess.run(["umount", disk], check=True)


def test_places_that_can_not_be_written_are_named(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("x")
    for folder in (tmp_path / "file", tmp_path / "file" / "out"):
        with pytest.raises(PaletteError, match=r"Output '.*' is a file or lies in one"), staged(folder):
            pytest.fail("the body ran")

    def refuse(self, *args, **kwargs):
        raise PermissionError(errno.EACCES, "Permission denied", str(self))

    monkeypatch.setattr(output.Path, "mkdir", refuse)  # root may write anywhere
    with pytest.raises(PaletteError, match="out' can't be written: Permission denied"), staged(tmp_path / "out"):
        pytest.fail("the body ran")
    monkeypatch.undo()
    with pytest.raises(PaletteError, match="out' can't be written"), staged(tmp_path / "out") as staging:
        raise PermissionError(errno.EACCES, "Permission denied", str(staging / "a.png"))
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_linked_folder_is_filled_where_it_points(tmp_path):
    (tmp_path / "there").mkdir()
    try:
        (tmp_path / "out").symlink_to(tmp_path / "there", target_is_directory=True)
    except OSError:
        pytest.skip("this system makes no links")
    with staged(tmp_path / "out") as staging:
        (staging / "palette.json").write_text("new")
    assert (tmp_path / "out").is_symlink() and (tmp_path / "there" / "palette.json").read_text() == "new"
