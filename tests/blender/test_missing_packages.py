"""Without torch and OpenCV the extension still enables, and says what is missing, why, and how to get it."""

import subprocess
import sys
from pathlib import Path

import pytest
from material_palette.core import dependencies

ROOT = Path(__file__).resolve().parents[2]

# Runs in an interpreter of its own: nothing that is imported here may hide a missing import there.
SCRIPT = """
import importlib.util, sys

BLOCKED = {blocked!r}

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in BLOCKED:
            raise ModuleNotFoundError(name, name=name)

sys.meta_path.insert(0, Blocker())
import bpy

path = {root!r}
spec = importlib.util.spec_from_file_location(
    "material_palette", path + "/__init__.py", submodule_search_locations=[path]
)
package = sys.modules["material_palette"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(package)
package.register()

from material_palette.core import dependencies
assert {{entry.module for entry in dependencies.missing()}} == BLOCKED
assert not BLOCKED & set(sys.modules)

bpy.context.scene.material_palette.photo = bpy.data.images.new("photo", 8, 8)
for operator in ("extract", "segment", "open_photo"):
    assert not getattr(bpy.ops.material_palette, operator).poll()
assert bpy.ops.material_palette.copy_install_command.poll()
try:
    bpy.ops.material_palette.extract()
except RuntimeError as error:
    print("REFUSED", error)

said = []
class Layout:
    def __getattr__(self, name):
        return lambda *arguments, **keywords: said.append(keywords.get("text", arguments[:1])) or self
    def __setattr__(self, name, value):
        pass

class Panel:
    layout = Layout()

from material_palette.panels import sidebar
sidebar.ExtractPanel.draw(Panel, bpy.context)
print("SAID", said)
assert any("copy_install_command" in str(text) for text in said)
for entry in dependencies.missing():
    assert any(entry.module in str(text) and entry.reason in str(text) for text in said), entry
package.unregister()
print("FINE")
"""


@pytest.mark.parametrize("blocked", [{"torch"}, {"torch", "cv2"}])
def test_extension_enables_and_says_what_is_missing(blocked):
    script = SCRIPT.format(blocked=blocked, root=str(ROOT))
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "FINE" in ran.stdout
    refused = next(line for line in ran.stdout.splitlines() if line.startswith("REFUSED"))
    assert all(name in refused for name in blocked)


def test_nothing_is_missing_here():
    assert dependencies.missing() == []


def test_install_command_names_this_python_and_keeps_its_numpy():
    import numpy

    torch = next(entry for entry in dependencies.REQUIRED if entry.module == "torch")
    command = dependencies.install_command([torch])
    assert command.startswith(f'"{sys.executable}" -m pip install torch')
    assert f"numpy=={numpy.__version__}" in command


def test_install_command_is_copied(extension, monkeypatch):
    import bpy
    from material_palette.operators import setup

    assert bpy.ops.material_palette.copy_install_command() == {"CANCELLED"}
    monkeypatch.setattr(setup, "missing", lambda entries=dependencies.REQUIRED: entries[-1:])
    assert bpy.ops.material_palette.copy_install_command() == {"FINISHED"}
    assert bpy.ops.material_palette.copy_install_command(modules="onnxruntime") == {"FINISHED"}


def test_engines_say_what_they_lack_and_what_is_to_be_chosen(tmp_path):
    def found(lacking, **chosen):
        def find(entries):
            return [entry for entry in entries if entry.module in lacking]

        listed = dependencies.engines(**chosen, find=find)
        return {engine.name: ([entry.module for entry in engine.missing], bool(engine.wanted)) for engine in listed}

    bare = found({"diffusers", "onnxruntime"})
    assert bare["Patch"] == bare["U-Net"] == bare["Auto Segment and Pick"] == ([], False)
    assert bare["Diffusion"] == (["diffusers"], True)
    assert bare["Segment Anything"] == bare["Materialistic"] == bare["ResNet-101"] == ([], True)
    without_torch = found({"torch"})
    assert without_torch["Patch"] == (["torch"], False) and without_torch["Auto Segment and Pick"] == ([], False)
    for name in ("mobile_encoder.onnx", "mobile_decoder.onnx", "model.ckpt"):
        (tmp_path / name).touch()
    chosen = found({"onnxruntime"}, model="sd.safetensors", pick=str(tmp_path), maps=str(tmp_path / "model.ckpt"))
    assert chosen["Segment Anything"] == (["onnxruntime"], False)
    assert chosen["Materialistic"] == ([], True)
    assert chosen["ResNet-101"] == chosen["Diffusion"] == ([], False)
    assert found(set(), pick=str(tmp_path / "model.ckpt"))["Materialistic"] == ([], False)


def test_the_preferences_name_every_engine_and_field(extension):
    from types import SimpleNamespace

    import bpy
    from material_palette.operators import preferences

    said = set()

    class Layout:
        def __getattr__(self, name):
            def call(*arguments, **keywords):
                said.update(arguments[1:2] if name == "prop" else [keywords.get("text")])
                return Layout()

            return call

        def __setattr__(self, name, value):
            pass

    preferences.MATERIAL_PALETTE_preferences.draw(SimpleNamespace(layout=Layout()), bpy.context)
    assert {engine.name for engine in dependencies.engines()} <= said
    fields = set(preferences.MATERIAL_PALETTE_preferences.__annotations__)
    assert fields and fields <= said
