"""dev.py says why it can't go on, makes its environment once, and makes it anew after an interruption."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import dev

posix = pytest.mark.skipif(os.name != "posix", reason="signals and scripts of POSIX")


@pytest.fixture
def clone(tmp_path, monkeypatch):
    """dev.py in an empty folder, run from outside its environment; setting up costs nothing.

    `.made` lists the environments made, `.became` the commands that dev.py handed over to."""
    requirements = tmp_path / "requirements.txt"
    requirements.write_text("one==1\n")
    (tmp_path / "requirements-diffusion.txt").write_text("two==2\n")
    clone = SimpleNamespace(root=tmp_path, requirements=requirements, venv=tmp_path / ".venv", made=[], became=[])

    def make_venv():
        python = Path(dev.venv_python(dev.VENV))
        python.parent.mkdir(parents=True)
        python.touch()
        (clone.venv / "pyvenv.cfg").touch()
        clone.made.append(dev.VENV)

    monkeypatch.setattr(dev, "ROOT", str(tmp_path))
    monkeypatch.setattr(dev, "VENV", str(clone.venv))
    monkeypatch.setattr(dev, "REQUIREMENTS", str(requirements))
    monkeypatch.setattr(dev, "PYTHONS", (sys.version_info[:2],))
    monkeypatch.setattr(dev, "make_venv", make_venv)
    monkeypatch.setattr(dev, "pip", lambda arguments: (0, []))
    monkeypatch.setattr(dev, "check_imports", lambda: None)
    monkeypatch.setattr(dev, "hand_over", lambda command: clone.became.append(command) or 0)
    return clone


def test_environment_is_made_once_and_the_command_handed_over(clone):
    assert dev.main(["test", "-x"]) == 0
    assert dev.main(["demo"]) == 0
    assert len(clone.made) == 1
    assert clone.became[0] == [dev.venv_python(str(clone.venv)), os.path.abspath(dev.__file__), "test", "-x"]


def test_packages_of_the_engine_diffusion_are_added_when_they_are_wanted(clone, monkeypatch):
    asked = []
    monkeypatch.setattr(dev, "pip", lambda arguments: asked.append(" ".join(arguments)) or (0, []))

    def added():
        return sum("requirements-diffusion.txt" in arguments for arguments in asked)

    dev.main(["demo"])
    assert added() == 0
    dev.main(["extract", "photo.jpg", "--engine", "diffusion"])
    dev.main(["test"])
    assert added() == 1 and len(clone.made) == 1


def test_packages_of_the_benchmarks_are_added_once_those_without_dependencies_by_themselves(clone, monkeypatch):
    text = (Path(dev.__file__).parent / "requirements-benchmarks.txt").read_text()
    (clone.root / "requirements-benchmarks.txt").write_text(text)
    asked = []
    monkeypatch.setattr(dev, "pip", lambda arguments: asked.append(arguments) or (0, []))
    dev.main(["bench", "--quick"])
    dev.main(["bench", "--quick"])
    added = [arguments for arguments in asked if "--no-deps" in arguments]
    assert len(added) == 1 and added[0][-2:] == ["stlpips-pytorch==0.0.2", "pypbr==0.1.0b5"]


def test_bench_runs_the_suites_named_and_says_when_one_failed(monkeypatch, tmp_path, capsys):
    ran = []
    monkeypatch.setattr(dev.subprocess, "call", lambda command, **more: ran.append(command) or "speed.py" in command[1])
    assert dev.bench(["texture", "speed", "--data", "D", "--quick", "-o", str(tmp_path), "--seeds", "2"]) == 1
    ran.sort(key=lambda command: "speed.py" in command[1])
    assert [Path(command[1]).name for command in ran] == ["texture.py", "speed.py"]
    assert ran[0][2:] == ["-o", str(tmp_path / "texture"), "--seeds", "2", "--data", "D", "--quick"]
    assert "speed: 0 s, FAILED" in capsys.readouterr().out


@pytest.mark.parametrize("wrong", [["nonsense", "--quick"], ["speed", "texture"], []])
def test_bench_refuses_an_unknown_suite_and_a_run_without_data(wrong, monkeypatch):
    monkeypatch.setattr(dev.subprocess, "call", pytest.fail)
    with pytest.raises(SystemExit):
        dev.bench(wrong)


def test_bench_asks_for_no_data_where_none_is_needed(monkeypatch, tmp_path):
    ran = []
    monkeypatch.setattr(dev.subprocess, "call", lambda command, **more: ran.append(command) or 0)
    assert dev.bench(["speed", "-o", str(tmp_path)]) == 0
    assert ran[0][2:] == ["-o", str(tmp_path / "speed")]


@pytest.mark.parametrize("change", ["requirements", "python"])
def test_environment_is_made_anew_when_it_no_longer_fits(clone, monkeypatch, change):
    dev.main(["demo"])
    if change == "requirements":
        clone.requirements.write_text("one==2\n")
    else:
        other = {**dev.stamp(), "python": "3.99"}
        monkeypatch.setattr(dev, "stamp", lambda: other)
    leftover = clone.venv / "leftover"
    leftover.touch()
    dev.main(["demo"])
    assert len(clone.made) == 2 and not leftover.exists()


def test_interrupted_set_up_ends_with_130_and_is_done_again(clone, monkeypatch):
    def interrupted(arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(dev, "pip", interrupted)
        assert dev.main(["demo"]) == 130
    assert not dev.is_ready() and not clone.became
    assert dev.main(["demo"]) == 0
    assert len(clone.made) == 2 and dev.is_ready()


def test_a_folder_that_is_no_environment_is_never_removed(clone, capsys):
    clone.venv.mkdir()
    precious = clone.venv / "thesis.tex"
    precious.touch()
    assert dev.main(["demo"]) == 1
    assert precious.exists() and "move it away" in capsys.readouterr().err


@pytest.mark.parametrize("argv, code", [([], 2), (["--help"], 0), (["dmeo"], 2)])
def test_usage_costs_no_environment(clone, capsys, argv, code):
    assert dev.main(argv) == code
    assert "dev.py demo" in capsys.readouterr().out and not clone.made


def test_wrong_python_names_the_right_ones_and_the_one_found(clone, monkeypatch, capsys):
    monkeypatch.setattr(dev, "PYTHONS", ((9, 1), (9, 3)))
    assert dev.main(["demo"]) == 1
    said = capsys.readouterr().err
    assert "9.1 or 9.3" in said and "{}.{}".format(*sys.version_info) in said and sys.executable in said
    assert not clone.made


@posix
def test_wrong_python_gives_way_to_a_right_one_that_really_runs(clone, monkeypatch):
    """A version manager's shim answers to the name of a Python that isn't there; it must not be believed."""
    folder = clone.root / "bin"
    folder.mkdir()
    for name, script in {"python9.1": "exit 127", "python9.3": "echo 9 3"}.items():
        (folder / name).write_text(f"#!/bin/sh\n{script}\n")
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(folder), prepend=os.pathsep)
    monkeypatch.setattr(dev, "PYTHONS", ((9, 1), (9, 3)))
    assert dev.main(["test", "-k", "torus"]) == 0
    assert clone.became == [[str(folder / "python9.3"), os.path.abspath(dev.__file__), "test", "-k", "torus"]]
    assert not clone.made


def test_too_little_disk_is_told_before_anything_is_made(clone, monkeypatch, capsys):
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=1.2e9))
    assert dev.main(["demo"]) == 1
    said = capsys.readouterr().err
    assert "1.2 GB are free" in said and "needs 4 GB" in said and "PIP_FIND_LINKS" in said
    assert not clone.made


# what pip really prints, abridged
NO_NETWORK = """\
WARNING: Retrying (Retry(total=0, connect=None)) after connection broken by 'NewConnectionError('<pip._vendor.urllib3.\
connection.HTTPSConnection object at 0x7f9b>: Failed to establish a new connection: [Errno 111] Connection refused')'
ERROR: Could not find a version that satisfies the requirement bpy==5.0.1 (from versions: none)
ERROR: No matching distribution found for bpy==5.0.1
"""
NO_BUILD = """\
ERROR: Could not find a version that satisfies the requirement bpy==5.0.1 (from versions: none)
ERROR: No matching distribution found for bpy==5.0.1
"""
NO_DISK = "ERROR: Could not install packages due to an OSError: [Errno 28] No space left on device\n"
NO_TRUST = "SSLError(SSLCertVerificationError(1, '[SSL: CERTIFICATE_VERIFY_FAILED] certificate verify failed'))\n"
OTHER = "ERROR: Hash mismatch of one-1.whl\n"


@pytest.mark.parametrize(
    "output, reason",
    [
        (NO_NETWORK, "no network"),
        (NO_BUILD, "finds no bpy==5.0.1 for this computer"),
        (NO_DISK, "disk is full"),
        (NO_TRUST, "PIP_CERT"),
        (OTHER, "Hash mismatch of one-1.whl"),
    ],
)
def test_failure_of_pip_gives_its_reason(clone, monkeypatch, capsys, output, reason):
    monkeypatch.setattr(dev, "pip", lambda arguments: (1, output.splitlines(keepends=True)))
    assert dev.main(["demo"]) == 1
    assert reason in capsys.readouterr().err
    assert not dev.is_ready() and (clone.venv / "pip.log").read_text() == output


def test_missing_system_libraries_are_named_with_their_packages():
    output = "ImportError: libXi.so.6: cannot open shared object file: No such file or directory"
    said = dev.import_failure(output, {"libSM.so.6"})
    assert "libSM.so.6, libXi.so.6" in said and "apt install libsm6 libxi6" in said


def test_python_of_an_environment_on_either_kind_of_system():
    assert dev.venv_python("e", windows=True).replace("\\", "/") == "e/Scripts/python.exe"
    assert dev.venv_python("e", windows=False).replace("\\", "/") == "e/bin/python"


def test_exit_code_is_the_programs(tmp_path):
    code = "import dev, sys; sys.exit(dev.hand_over([sys.executable, '-c', 'raise SystemExit(3)']))"
    assert subprocess.run([sys.executable, "-c", code], cwd=Path(dev.__file__).parent).returncode == 3


@posix
@pytest.mark.parametrize("when", ["running", "importing"])
def test_ctrl_c_ends_a_command_with_130(tmp_path, when):
    """Also while libraries are imported, which must neither swallow it nor be left half imported."""
    (tmp_path / "library.py").write_text("import time; print('importing', flush=True); time.sleep(0.5); print('whole')")
    code = f"""
import sys
sys.path[:0] = [{str(Path(dev.__file__).parent)!r}]
import dev, time
def demo(arguments):
    dev.import_libraries()
    print("running", flush=True)
    time.sleep(60)
dev.VENV, dev.is_ready, dev.LIBRARIES = sys.prefix, lambda: True, ["library"]
dev.COMMANDS["demo"] = demo
sys.exit(dev.main(["demo"]))
"""
    with subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # a shell in the background of CI starts its children with SIGINT ignored
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:
        read = []
        while when not in read:
            read.append(process.stdout.readline().strip())
        process.send_signal(signal.SIGINT)
        rest, said = process.communicate(timeout=20)
    assert process.returncode == 130
    assert "whole" in read + rest.split() and "running" not in rest
    assert "Traceback" not in said


def test_the_root_is_loaded_under_one_name_only():
    """The root is a package; pytest must not import it a second time under the clone's folder name."""
    root_init = Path(dev.__file__).with_name("__init__.py")
    names = [n for n, m in list(sys.modules.items()) if getattr(m, "__file__", None) == str(root_init)]
    assert names == ["material_palette"]
