#!/usr/bin/env python3
"""The developer's front door; needs nothing but Python itself.

    python3 dev.py demo    [arguments of extract]       a palette of the bundled photo, into demo/
    python3 dev.py extract PHOTO... -o DIR [...]        the extension's command line, without Blender
    python3 dev.py resample CONCEPT... -o DIR [...]     its other command
    python3 dev.py test    [--quick] [arguments of pytest]
    python3 dev.py bench   [SUITE ...] [--data DIR] [--quick] [-o DIR]    seconds against accuracy, stability
    python3 dev.py package [--wheels | --wheels all]    the extension's zip, into dist/

The first call makes an environment in .venv/ (Blender as a module, torch, OpenCV: requirements.txt); later ones
reuse it until requirements.txt or the Python changes. `test` and `--engine diffusion` add what
requirements-diffusion.txt lists, `bench` what requirements-benchmarks.txt does. pip's own settings (PIP_INDEX_URL,
PIP_EXTRA_INDEX_URL, PIP_FIND_LINKS) are respected.
"""

# Compiles on every Python 3 from 3.6 on, so that a wrong one is told by name and not by a syntax error.
import argparse
import contextlib
import glob
import hashlib
import importlib.util
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor

ROOT = os.path.dirname(os.path.abspath(__file__))
VENV = os.path.join(ROOT, ".venv")
REQUIREMENTS = os.path.join(ROOT, "requirements.txt")
EXAMPLE = os.path.join(ROOT, "examples", "viaduct")
PYTHONS = ((3, 11), (3, 13))  # the ones Blender's modules in requirements.txt are built for
LIBRARIES = ("bpy", "cv2", "numpy", "OpenImageIO", "torch")  # what requirements.txt installs for the pipeline
DISK_NEEDED = 4e9  # bytes: 2 GB installed, the rest for pip's downloads and unpacking
ZIP_LIMIT = 45e6  # bytes, without wheels
DEBIAN_PACKAGES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libICE.so.6": "libice6",
    "libSM.so.6": "libsm6",
    "libX11.so.6": "libx11-6",
    "libXext.so.6": "libxext6",
    "libXfixes.so.3": "libxfixes3",
    "libXi.so.6": "libxi6",
    "libXrender.so.1": "libxrender1",
    "libXt.so.6": "libxt6",
    "libgomp.so.1": "libgomp1",
    "libxkbcommon.so.0": "libxkbcommon0",
}


class SetupError(Exception):
    """The environment can't be made or used; the message says why and what to do."""


# ---------------------------------------------------------------- the environment


def named(versions):
    return " or ".join("{}.{}".format(*v) for v in versions)


def version_of(command):
    """(major, minor) of the Python that a command starts, None when it starts none."""
    probe = [*command, "-c", "import sys; print('%d %d' % sys.version_info[:2])"]
    try:
        out = subprocess.run(probe, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, timeout=60).stdout.split()
        return int(out[0]), int(out[1])
    except (OSError, subprocess.SubprocessError, ValueError, IndexError):
        return None


def supported_python():
    """The command of a Python that bpy is built for: this one, else the first found on the PATH."""
    here = tuple(sys.version_info[:2])
    if here in PYTHONS:
        return [sys.executable]
    for version in PYTHONS:
        name = "{}.{}".format(*version)
        for command in (["py", "-" + name], ["python" + name]):
            # asked, not believed: a version manager's shim stands on the PATH for a Python that is switched off
            if shutil.which(command[0]) and version_of(command) == version:
                return command
    raise SetupError(
        "Python {} is needed; this is Python {}.{} ({}), and no other was found on the PATH.\n"
        "Install one of them and run: python{}.{} dev.py ...".format(
            named(PYTHONS), *(here + (sys.executable,) + PYTHONS[0])
        )
    )


def venv_python(venv, windows=os.name == "nt"):
    return os.path.join(venv, "Scripts", "python.exe") if windows else os.path.join(venv, "bin", "python")


def stamp():
    """What the environment must have been made from to be used again."""
    with open(REQUIREMENTS, "rb") as file:
        digest = hashlib.sha256(file.read().replace(b"\r\n", b"\n")).hexdigest()
    return {"requirements": digest, "python": "{}.{}".format(*sys.version_info)}


def is_ready():
    """True when the environment is complete and made from these requirements with this Python's version."""
    try:
        with open(os.path.join(VENV, "ready.json")) as file:
            return json.load(file) == stamp() and os.path.exists(venv_python(VENV))
    except (OSError, ValueError):
        return False


def check_disk():
    free = shutil.disk_usage(ROOT).free
    if free < DISK_NEEDED:
        raise SetupError(
            "not enough disk: {:.1f} GB are free in {}, the environment needs {:.0f} GB.\n{}".format(
                free / 1e9, ROOT, DISK_NEEDED / 1e9, CUDA_NOTE
            )
        )


CUDA_NOTE = (
    "On Linux the torch of pip's usual index is a CUDA build of several GB more (10 GB in all). To take a CPU build,\n"
    "set PIP_INDEX_URL, PIP_EXTRA_INDEX_URL or PIP_FIND_LINKS to where one lies."
)


def clean_environ():
    """This process's variables less those that would let foreign packages into the environment."""
    environ = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "__PYVENV_LAUNCHER__")}
    environ["PYTHONNOUSERSITE"] = "1"
    return environ


@contextlib.contextmanager
def locked():
    """One set-up at a time; the system drops the lock when its process ends, however it ends."""
    with open(VENV + ".lock", "w") as file:
        if os.name == "nt":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_LOCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def ensure_environment():
    """Make .venv unless it is ready. The stamp is written last: what was interrupted is made anew."""
    if is_ready():
        return
    with locked():
        if is_ready():  # another call has just made it
            return
        check_disk()
        start = time.time()
        print("Making the environment in {} with Python {} (once)".format(VENV, platform.python_version()), flush=True)
        if sys.platform == "linux" and not any(
            os.environ.get("PIP_" + name) for name in ("INDEX_URL", "EXTRA_INDEX_URL", "FIND_LINKS")
        ):
            print(CUDA_NOTE, flush=True)
        remove_environment()
        make_venv()
        install()
        check_imports()
        with open(os.path.join(VENV, "ready.json"), "w") as file:
            json.dump(stamp(), file)
        print("Environment ready, {:.0f} s".format(time.time() - start), flush=True)


def ensure_added(name):
    """Add the packages of requirements-<name>.txt to .venv, once; what it calls `no-deps` without what they ask for."""
    wanted, done = os.path.join(ROOT, "requirements-{}.txt".format(name)), os.path.join(VENV, name + ".txt")
    with open(wanted, encoding="utf-8") as file:
        text = file.read()
    with locked():
        if os.path.exists(done):
            with open(done, encoding="utf-8") as file:
                if file.read() == text:
                    return
        print("Adding the packages of {} (once)".format(os.path.basename(wanted)), flush=True)
        code, lines = pip(["install", "--progress-bar", "off", "-r", wanted, "-c", REQUIREMENTS])
        alone = re.findall(r"pip install --no-deps (\S+==[\w.]+)", text)
        if not code and alone:
            code, lines = pip(["install", "--progress-bar", "off", "--no-deps", *alone])
        if code:
            raise SetupError(pip_failure(lines))
        with open(done, "w", encoding="utf-8") as file:
            file.write(text)


def remove_environment():
    if not os.path.lexists(VENV):
        return
    if os.listdir(VENV) and not os.path.exists(os.path.join(VENV, "pyvenv.cfg")):
        raise SetupError(VENV + " is not an environment; move it away.")
    try:
        shutil.rmtree(VENV)
    except OSError as error:
        raise SetupError("can't renew {}: {}. Is a program of it still running?".format(VENV, error)) from None


def make_venv():
    if importlib.util.find_spec("venv") is None or importlib.util.find_spec("ensurepip") is None:
        raise SetupError(
            "this Python ({}) lacks venv or ensurepip. On Debian and Ubuntu: apt install python{}.{}-venv".format(
                sys.executable, *sys.version_info[:2]
            )
        )
    made = subprocess.run(
        [sys.executable, "-m", "venv", VENV],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        universal_newlines=True,
        env=clean_environ(),
    )
    if made.returncode:
        raise SetupError("can't make {}:\n{}".format(VENV, made.stdout.strip()))


def install():
    """pip install -r requirements.txt; the whole log stays in .venv/pip.log."""
    code, lines = pip(["install", "--progress-bar", "off", "-r", REQUIREMENTS])
    with open(os.path.join(VENV, "pip.log"), "w", encoding="utf-8") as file:
        file.writelines(lines)
    if code:
        raise SetupError(pip_failure(lines))


def pip(arguments):
    """Run the environment's pip, showing its main steps; its exit code and all its lines."""
    process = subprocess.Popen(
        [venv_python(VENV), "-m", "pip", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=clean_environ(),
    )
    lines = []
    try:
        for raw in process.stdout:
            line = raw.decode("utf-8", "replace")
            lines.append(line)
            if re.match(r"\s*(Collecting|Downloading|Installing) ", line):
                print("  " + line.split(" (from ")[0].strip()[:110], flush=True)
        return process.wait(), lines
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


def pip_failure(lines):
    """The reason in pip's output, in one or two sentences."""
    text = "".join(lines)
    if "No space left on device" in text or "[Errno 28]" in text:
        return "the disk is full: {} or pip's temporary folder {}.\n{}".format(ROOT, tempfile.gettempdir(), CUDA_NOTE)
    if "CERTIFICATE_VERIFY_FAILED" in text:
        return (
            "no secure connection to the package index: its certificate isn't trusted here. Behind a proxy that signs "
            "anew, set PIP_CERT to its certificate."
        )
    unreachable = r"NewConnectionError|NameResolutionError|TimeoutError|ProxyError|ConnectionError|Max retries"
    if re.search(unreachable, text):
        return (
            "no network: pip can't reach the package index. Check the connection, or set PIP_INDEX_URL or "
            "PIP_FIND_LINKS to one that can be reached."
        )
    missing = re.search(r"No matching distribution found for (\S+)", text)
    if missing:
        return (
            "pip finds no {} for this computer ({}, {}, Python {}). Blender's module exists for Linux x86-64 "
            "(glibc 2.28 or newer), Windows and macOS on Apple silicon.".format(
                missing.group(1), platform.system(), platform.machine(), platform.python_version()
            )
        )
    return "pip failed; its last lines:\n" + "".join(lines[-12:]).rstrip()


def check_imports():
    """Refuse an environment whose compiled modules don't load; name the system libraries that are missing."""
    done = subprocess.run(
        [venv_python(VENV), "-c", "import " + ", ".join(LIBRARIES)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=clean_environ(),
    )
    if done.returncode:
        raise SetupError(import_failure(done.stdout.decode("utf-8", "replace"), missing_libraries()))


def missing_libraries():
    """Shared libraries that bpy and cv2 want and the loader does not find (Linux; elsewhere none are known)."""
    found = set()
    if sys.platform == "linux" and shutil.which("ldd"):
        for module in glob.glob(os.path.join(VENV, "lib", "python*", "site-packages", "[bc][pv][y2]", "*.so")):
            listed = subprocess.run(["ldd", module], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
            found.update(re.findall(r"(\S+) => not found", listed.stdout.decode("utf-8", "replace")))
    return found


def import_failure(output, libraries):
    """The reason why an import failed, from Python's output and the libraries known to be missing."""
    libraries = set(libraries) | set(re.findall(r"(\S+\.so[\w.]*): cannot open shared object file", output))
    if libraries:
        packages = sorted({DEBIAN_PACKAGES[name] for name in libraries if name in DEBIAN_PACKAGES})
        reason = "system libraries are missing: " + ", ".join(sorted(libraries))
        return reason + (".\nOn Debian and Ubuntu: apt install " + " ".join(packages) if packages else ".")
    old = re.search(r"version `(GLIBC\w*_[\d.]+)' not found", output)
    if old:
        return "this system is too old for Blender's module: it lacks {}.".format(old.group(1))
    return "the installed packages don't load:\n" + output.strip()[-1500:]


# ---------------------------------------------------------------- the commands, inside the environment


def load_package():
    """The repository's root as the package `material_palette`, whatever the clone's folder is called."""
    if "material_palette" not in sys.modules:
        spec = importlib.util.spec_from_file_location(
            "material_palette", os.path.join(ROOT, "__init__.py"), submodule_search_locations=[ROOT]
        )
        module = importlib.util.module_from_spec(spec)
        sys.modules["material_palette"] = module
        spec.loader.exec_module(module)
    return sys.modules["material_palette"]


def import_libraries():
    """Import what the pipeline needs, and let Ctrl-C wait for it: the imports of compiled modules swallow it."""
    pressed = []
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # and not ignored, as in a shell's background job
        signal.signal(signal.SIGINT, lambda number, frame: pressed.append(number))
    try:
        for name in LIBRARIES:
            importlib.import_module(name)
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        raise KeyboardInterrupt


def extract(arguments):
    import_libraries()
    load_package()
    return importlib.import_module("material_palette.core.command").main(["extract", *arguments])


def resample(arguments):
    import_libraries()
    load_package()
    return importlib.import_module("material_palette.core.command").main(["resample", *arguments])


def demo(arguments):
    parser = argparse.ArgumentParser(prog="dev.py demo", description="Further arguments are those of extract.")
    parser.add_argument("-o", "--output", default=os.path.join(ROOT, "demo"), help="folder, written anew (demo/)")
    options, rest = parser.parse_known_args(arguments)
    photo, masks = os.path.join(EXAMPLE, "photo.jpg"), os.path.join(EXAMPLE, "masks")
    start = time.time()
    code = extract([photo, "--masks", masks, "--overwrite", "-o", options.output, *rest])
    if code in (0, 3):
        report(options.output, time.time() - start)
    return code


def report(folder, seconds):
    """Print the files of a palette with their sizes, and the seconds of every stage."""
    print("\nWrote " + folder)
    for path in sorted(glob.glob(os.path.join(folder, "**", "*"), recursive=True)):
        if os.path.isfile(path):
            print("  {:8.1f} kB  {}".format(os.path.getsize(path) / 1e3, os.path.relpath(path, folder)))
    with open(os.path.join(folder, "palette.json"), encoding="utf-8") as file:
        palette = json.load(file)
    print("Seconds")
    for owner, stages in [("palette", palette["seconds"])] + [(m["name"], m["seconds"]) for m in palette["materials"]]:
        print("  {:<16}  {}".format(owner, "  ".join("{} {:.1f}".format(*stage) for stage in stages.items())))
    print("  {:<16}  {:.1f}".format("in all", seconds))


def test(arguments):
    import pytest

    os.chdir(ROOT)
    if "--quick" in arguments:
        arguments = [a for a in arguments if a != "--quick"] + ["-m", "not slow"]
    return int(pytest.main(arguments))


# the longest first, for two at a time
SUITES = ("endtoend", "speed", "stability", "rendered", "exemplar", "texture", "svbrdf", "needs", "segmentation")
WITH_DATA = ("exemplar", "svbrdf", "segmentation")  # have no data of their own
WITHOUT_DATA = ("speed",)  # have all they need


def bench(arguments):
    """Run the suites, each in a process of its own and a folder of its own; two at a time if they are quick."""
    parser = argparse.ArgumentParser(prog="dev.py bench", description="Further arguments are those of the suites.")
    parser.add_argument("suites", nargs="*", metavar="SUITE", help=", ".join(SUITES) + " (all)")
    parser.add_argument("--data", help="the folder that benchmarks/README.md describes; without: procedural materials")
    parser.add_argument("--quick", action="store_true", help="little of each, to see that it works: under 5 minutes")
    parser.add_argument("-o", "--output", default=os.path.join(ROOT, "dist", "benchmarks"), help="(dist/benchmarks)")
    options, rest = parser.parse_known_args(arguments)
    unknown = [suite for suite in options.suites if suite not in SUITES]
    if unknown:
        parser.error("there is no suite '{}'; choose from: {}".format(unknown[0], ", ".join(SUITES)))
    if not options.data and not options.quick and not set(options.suites or SUITES) <= set(WITHOUT_DATA):
        parser.error("give --data DIR, or --quick")
    failed = []

    def run(suite):
        command = [sys.executable, script_of(suite), "-o", os.path.join(options.output, suite), *rest]
        if options.data or suite in WITH_DATA:
            command += ["--data", data]
        if options.quick:
            command.append("--quick")
        start = time.time()
        print("==== {}\n".format(suite), end="", flush=True)
        with tempfile.TemporaryFile() as said:
            # one thread: torch's own wait on each other when a core is busy
            environment = dict(os.environ, OMP_NUM_THREADS="1")
            code = subprocess.call(command, env=environment, stdout=said if options.quick else None)
            said.seek(0)
            print(said.read().decode(errors="replace"), end="")
        print("==== {}: {:.0f} s{}".format(suite, time.time() - start, ", FAILED" if code else ""), flush=True)
        failed.extend([suite] if code else [])

    suites = options.suites or [s for s in SUITES if os.path.exists(script_of(s))]
    data = options.data or (made_data() if set(suites) & set(WITH_DATA) else None)
    with ThreadPoolExecutor(2 if options.quick else 1) as pool:  # seconds count in whole runs only
        list(pool.map(run, suites))
    return 1 if failed else 0


def script_of(suite):
    return os.path.join(ROOT, "benchmarks", suite + ".py")


def made_data():
    load_package()
    folder = os.path.join(ROOT, "dist", "benchmarks", "data")
    importlib.import_module("material_palette.benchmarks.made").make_data(folder)
    return folder


def package(arguments):
    parser = argparse.ArgumentParser(prog="dev.py package")
    parser.add_argument(
        "--wheels",
        nargs="?",
        const="opencv",
        choices=("opencv", "all"),
        help="bundle PyPI's wheels for this platform and Python: OpenCV, or with `all` torch too",
    )
    parser.add_argument("-o", "--output", default=os.path.join(ROOT, "dist"), help="folder of the zip (dist/)")
    options = parser.parse_args(arguments)
    bpy_folder = importlib.util.find_spec("bpy").submodule_search_locations[0]
    builder = glob.glob(os.path.join(bpy_folder, "*", "scripts", "addons_core", "bl_pkg", "cli", "blender_ext.py"))[0]
    os.makedirs(options.output, exist_ok=True)
    with tempfile.TemporaryDirectory() as staging, tempfile.TemporaryDirectory(dir=options.output) as built:
        for path in source_files():
            target = os.path.join(staging, path)
            os.makedirs(os.path.dirname(target), exist_ok=True)
            shutil.copyfile(os.path.join(ROOT, path), target)
        if options.wheels:
            add_wheels(staging, options.wheels)
        build = ["build", "--source-dir", staging, "--output-dir", built]
        run_builder(builder, build + (["--split-platforms"] if options.wheels else []))  # names the zip after it
        run_builder(builder, ["validate", *glob.glob(os.path.join(built, "*.zip"))])
        (made,) = glob.glob(os.path.join(built, "*.zip"))
        size = os.path.getsize(made)
        if size > ZIP_LIMIT and not options.wheels:
            raise SetupError("the zip has {:.1f} MB, the limit is {:.0f} MB".format(size / 1e6, ZIP_LIMIT / 1e6))
        final = os.path.join(options.output, os.path.basename(made))
        os.replace(made, final)
    print("{}  {:.2f} MB, valid".format(final, size / 1e6))
    return 0


def run_builder(builder, arguments):
    done = subprocess.run([sys.executable, builder, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    if done.returncode:
        raise SetupError(done.stdout.decode("utf-8", "replace").strip())


def source_files():
    """Paths under ROOT that may go into the zip: git's, or without git all but hidden and made ones.

    The manifest's `paths_exclude_pattern` decides further; this keeps it from walking through .venv."""
    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        listed = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            cwd=ROOT,
            check=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        ).stdout.decode("utf-8")
        paths = sorted(path for path in set(listed.split("\0")) if os.path.isfile(os.path.join(ROOT, path)))
        if "blender_manifest.toml" in paths:
            return paths
    paths = []
    for folder, folders, files in os.walk(ROOT):
        made = ("demo", "dist") if folder == ROOT else ()
        folders[:] = [f for f in folders if not f.startswith(".") and f != "__pycache__" and f not in made]
        paths += [os.path.relpath(os.path.join(folder, f), ROOT) for f in files if not f.startswith(".")]
    return sorted(paths)


def add_wheels(staging, which):
    """Download unmodified wheels into staging/wheels and declare them in the staged manifest."""
    wheels = os.path.join(staging, "wheels")
    wanted = ["opencv-contrib-python-headless"] + (["torch"] if which == "all" else [])
    arguments = ["download", "--progress-bar", "off", "--only-binary", ":all:", "-d", wheels, "-c", REQUIREMENTS]
    code, lines = pip(arguments + wanted)
    if code:
        raise SetupError(pip_failure(lines))
    for path in glob.glob(os.path.join(wheels, "numpy-*.whl")):
        os.remove(path)  # Blender brings its own
    system = {"Linux": "linux", "Darwin": "macos", "Windows": "windows"}[platform.system()]
    machine = {"x86_64": "x64", "amd64": "x64", "aarch64": "arm64"}.get(
        platform.machine().lower(), platform.machine().lower()
    )
    names = sorted(os.path.basename(path) for path in glob.glob(os.path.join(wheels, "*.whl")))
    declared = "platforms = {}\nwheels = {}\n".format(
        json.dumps([system + "-" + machine]), json.dumps(["./wheels/" + name for name in names], indent=2)
    )
    manifest = os.path.join(staging, "blender_manifest.toml")
    with open(manifest, encoding="utf-8") as file:
        text = file.read()
    # a manifest's own keys stand before its first [table]
    text, found = re.subn(r"(?m)^\[", lambda match: declared + "\n[", text, count=1)
    with open(manifest, "w", encoding="utf-8", newline="\n") as file:
        file.write(text if found else text + "\n" + declared)


COMMANDS = {"demo": demo, "extract": extract, "resample": resample, "test": test, "bench": bench, "package": package}


# ---------------------------------------------------------------- from the outside in


def hand_over(command):
    """Become `command`; where a process can't, run it and pass its exit code on."""
    sys.stdout.flush()
    sys.stderr.flush()
    if os.name == "posix":  # signals and the exit code are the program's own
        os.execve(command[0], command, clean_environ())
    process = subprocess.Popen(command, env=clean_environ())
    while True:
        try:
            return process.wait()
        except KeyboardInterrupt:
            pass  # the program has got it too, and ends in its own way


def main(argv):
    if not argv or argv[0] not in COMMANDS:
        print(__doc__.strip())
        return 0 if argv in (["-h"], ["--help"]) else 2
    try:
        if os.path.realpath(sys.prefix) == os.path.realpath(VENV):
            if not is_ready():
                raise SetupError("requirements.txt has changed: run dev.py with the Python outside {}".format(VENV))
            return COMMANDS[argv[0]](argv[1:])
        python = supported_python()
        if python != [sys.executable]:
            python[0] = shutil.which(python[0])
            return hand_over([*python, os.path.abspath(__file__), *argv])
        ensure_environment()
        if argv[0] == "test" or "diffusion" in argv:
            ensure_added("diffusion")
        if argv[0] == "bench":
            ensure_added("benchmarks")
        return hand_over([venv_python(VENV), os.path.abspath(__file__), *argv])
    except SetupError as error:
        print("dev.py: {}".format(error), file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("dev.py: stopped", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
