from __future__ import annotations

import configparser
import ctypes
import importlib
import os
import re
import subprocess
import sys
from collections.abc import Iterable
from fnmatch import fnmatch
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numba
import numpy as np
import pytest
from command_line import refused

import gvtools
from gvtools.kernels import KernelSet, compile_side_by_side, in_threads
from gvtools.system_libraries import LIBRARIES, missing_libraries
from pipelines import cli
from pipelines.options import Arguments

ROOT = Path(__file__).resolve().parents[1]
# conda-forge's names where they are not PyPI's.
CONDA = {"torch": "pytorch", "opencv-python-headless": "py-opencv", "matplotlib": "matplotlib-base"}


def setup() -> configparser.ConfigParser:
    found = configparser.ConfigParser()
    found.read(ROOT / "setup.cfg")
    return found


@pytest.fixture(scope="module", params=["cpu", "cuda"])
def steps(request):
    """Instructions of a Dockerfile in order, as (instruction, value)."""
    parse = pytest.importorskip("dockerfile_parse", reason="dockerfile-parse is not installed")
    file = ROOT / "packaging" / f"{request.param}.Dockerfile"
    parser = parse.DockerfileParser(path=str(file), fileobj=None)
    return [(each["instruction"], each["value"]) for each in parser.structure]


def of(steps, instruction: str) -> list[str]:
    return [value for name, value in steps if name == instruction]


def python(*words: object, path: Iterable[object] = (), **options: Any) -> Any:
    """A Python of its own that finds modules in these folders first."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path))}
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, env=env, text=True, capture_output=True, **options)


def test_a_container_is_pinned_whole_and_runs_as_nobody_in_particular(steps):
    base = next(value for value in of(steps, "ARG") if value.startswith("BASE="))
    name, _, tag = base.removeprefix("BASE=").rpartition(":")
    assert name and re.match(r"\d+\.\d+", tag)
    assert of(steps, "FROM") == ["${BASE} AS build", "${BASE}"]
    allowed = [line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines()
               if line.startswith("!")]  # fmt: skip
    copied = {
        source for value in of(steps, "COPY") if not value.startswith("--from")
        for source in value.split()[:-1]
    }  # fmt: skip
    assert copied == set(allowed)
    assert all((ROOT / source).exists() for source in copied)
    # All that the wheel is made of.
    packages = setup()["options.packages.find"]["include"].split()
    assert all(any(fnmatch(name, pattern) for name in copied) for pattern in packages)
    installs = [part for value in of(steps, "RUN") for part in value.split("&&")
                if "pip install" in part]  # fmt: skip
    assert len(installs) == 2
    assert all("-c constraints.txt" in part for part in installs)
    extras = next(v for v in of(steps, "ARG") if v.startswith("EXTRAS=")).removeprefix("EXTRAS=")
    assert set(extras.split(",")) <= set(setup()["options.extras_require"])
    last = [name for name, _ in steps].index("FROM", 3)
    installed = " ".join(v for name, v in steps[last:] if name == "RUN" and "apt-get" in v).split()
    assert set(LIBRARIES.values()) <= set(installed)
    assert of(steps, "USER")[-1].isdecimal() and not {"0", "root"} & {*of(steps, "USER")}
    assert of(steps, "ENTRYPOINT") == ['["gvtools"]']
    # Torch comes from its own index, and nothing else does.
    (run,) = [value for value in of(steps, "RUN") if "TORCH_INDEX" in value]
    assert "--no-deps" in run and run.split()[-1] == "torch"
    assert any(
        v.startswith("TORCH_INDEX=https://download.pytorch.org/whl/") for v in of(steps, "ARG")
    )


def test_the_conda_recipe_asks_for_what_the_package_does():
    rattler = pytest.importorskip("rattler_build", reason="py-rattler-build is not installed")
    (variant,) = rattler.Stage0Recipe.from_file(ROOT / "packaging" / "recipe.yaml").render()
    recipe = variant.recipe.to_dict()
    assert recipe["package"] == {"name": "gvtools", "version": gvtools.__version__}
    expected = {f"python {setup()['options']['python_requires']}"}
    for line in setup()["options"]["install_requires"].split():
        ((name, bounds),) = re.findall(r"([\w-]+)(.*)", line)
        expected.add(f"{CONDA.get(name, name)} {bounds}")
    assert set(recipe["requirements"]["run"]) == expected
    scripts = setup()["options.entry_points"]["console_scripts"].split("\n")[1:]
    assert recipe["build"]["python"]["entry_points"] == scripts


@pytest.mark.parametrize(("name", "content"), [("viz", ""), ("pipelines", "raise SystemExit"),
                                               ("data_specs", None)])  # fmt: skip
def test_a_foreign_package_first_on_the_path_is_one_line(name, content, tmp_path):
    if content is None:
        (tmp_path / f"{name}.py").write_text("")
    else:
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(content)
    done = python("-m", "gvtools", "--version", path=(tmp_path, ROOT), cwd=tmp_path)
    assert done.returncode == 2 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert str(tmp_path / name) in line and "PYTHONPATH" in line
    script = "import gvtools; gvtools.SpatialMemory; gvtools.reconstruct"
    done = python("-c", script, path=(tmp_path, ROOT), cwd=tmp_path)
    assert done.returncode == 1 and f"ImportError: package {name!r} is found at" in done.stderr


ELSEWHERE = """
import importlib, os, pkgutil, sys
import cv2, kornia, matplotlib.pyplot, numba, open3d, pycolmap, scipy.optimize, skimage, torch
for name in ("fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"):
    sys.modules[name] = None
for name in ("fork", "getloadavg", "getuid", "kill", "sched_getaffinity", "setsid", "statvfs"):
    delattr(os, name)
sys.platform = sys.argv[1]
own = ("gvtools", "pipelines", "viz")
for module in (m for name in own for m in pkgutil.walk_packages([name], name + ".")):
    try:
        importlib.import_module(module.name)
    except ImportError as error:  # of an extra that is not installed
        if error.name in sys.modules or error.name.split(".")[0] in own:
            print(f"{module.name}: {error!r}")
from tiny_scan import write_scan
from pathlib import Path
from pipelines.cli import main
scan = write_scan(Path(sys.argv[2]) / "scan", views=5)
words = ("--refine", "0", "--quiet", "--out", str(scan.with_name("run")))
sys.exit(main(["reconstruct", str(scan), *words]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("platform", ["win32", "darwin"])
def test_all_modules_and_a_run_need_nothing_of_posix(platform, tmp_path):
    path = (ROOT, ROOT / "tests/fixtures")
    done = python("-c", ELSEWHERE, platform, tmp_path, path=path, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.strip() == ""
    assert (tmp_path / "run" / "memory.npz").is_file()


@pytest.fixture
def bare(monkeypatch):
    load = ctypes.CDLL

    def lacking(name: str, *words: Any, **options: Any) -> object:
        if name in ("libGL.so.1", "libusb-1.0.so.0"):
            raise OSError(f"{name}: cannot open shared object file: No such file or directory")
        return load(name, *words, **options)

    monkeypatch.setattr(ctypes, "CDLL", lacking)


def test_missing_libraries_are_found_by_loading_them(bare, capsys, tmp_path):
    assert {"libGL.so.1", "libusb-1.0.so.0"} <= set(missing_libraries())
    # What needs none of them is as it was.
    with pytest.raises(SystemExit) as stop:
        cli.main(["--version"])
    assert stop.value.code == 0
    assert "no such file" in refused(capsys, "view", tmp_path / "absent")


@pytest.mark.parametrize(
    ("error", "told"),
    [(OSError("libGL.so.1: cannot open shared object file: No such file or directory"), True),
     (ImportError("libGL.so.1: cannot open shared object file"), True),
     (OSError("no space left on device"), False), (ValueError("libGL.so.1"), False)],
)  # fmt: skip
def test_a_command_names_the_libraries_that_it_lacks(bare, monkeypatch, capsys, error, told):
    class Lacking(Arguments):
        def run(self, console: object) -> None:
            raise error

    module = SimpleNamespace(LackingCommand=Lacking)
    monkeypatch.setitem(sys.modules, "lacking", module)
    status = cli.main(["lacking"], modules={"lacking": "lacking"})
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert status == (2 if told else 1)
    assert ("libGL.so.1 libusb" in said and "apt-get install -y" in said) == told


def test_make_and_the_program_know_the_same_list():
    done = python("-S", "-E", ROOT / "gvtools/system_libraries.py", check=True)
    expected = [f"{name} {LIBRARIES[name]}" for name in missing_libraries()]
    assert done.stdout.split("\n")[:-1] == (expected or [""])


MODULE = """
from gvtools.kernels import compiled

@compiled()
def {name}(x):
    return 2 * x

def compile_it():
    {name}(3)
"""


@pytest.mark.parametrize("count", [0, 1, 7, 1000])
def test_threads_share_the_work(count):
    seen = np.zeros(count, np.int64)

    def part(first: int, last: int, step: int) -> int:
        seen[first:last] += step
        return last - first

    sizes = in_threads(part, count, 2)
    assert (seen == 2).all() and sum(sizes) == count
    assert len(sizes) <= max(1, min(count, numba.get_num_threads()))
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda first, last: 1 // 0, 8)


def test_other_processes_leave_kernels_in_the_cache(tmp_path, monkeypatch, capfd):
    monkeypatch.syspath_prepend(tmp_path)
    sets = []
    for name in ("double_once", "double_twice"):
        (tmp_path / f"module_{name}.py").write_text(MODULE.format(name=name), encoding="utf-8")
        module = importlib.import_module(f"module_{name}")
        sets.append(KernelSet(name, module.compile_it, getattr(module, name)))
    # One that fails stops no other, and is compiled where it is called.
    broken = KernelSet("broken", os.wait, sets[0].last)
    assert not any(kernels.cached for kernels in sets)
    compile_side_by_side([broken, *sets])
    assert all(kernels.cached for kernels in sets)
    assert capfd.readouterr() == ("", "")
    # A file that is newer, and the same, is not compiled again; one that changed is.
    os.utime(tmp_path / "module_double_once.py", (2**31, 2**31))
    (tmp_path / "module_double_twice.py").write_text(
        MODULE.format(name="double_twice") + "# changed\n", encoding="utf-8"
    )
    module = importlib.reload(importlib.import_module("module_double_twice"))
    changed = KernelSet("changed", module.compile_it, module.double_twice)
    assert sets[0].cached and not changed.cached
    for kernels in sets:
        assert kernels.last(3) == 6
        assert kernels.last.stats.cache_hits.total() == 1


def test_where_nothing_can_be_written_the_cache_is_a_folder_that_goes(tmp_path):
    code = (
        "from gvtools import kernels; import os; from pathlib import Path;"
        "from gvtools.memory.store import voxel_index;"
        "assert kernels.cached_here_alone and Path(os.environ['NUMBA_CACHE_DIR']).is_dir();"
        # An older TBB is warned of where it comes first.
        "import numba; numba.config.reload_config();"
        "assert numba.config.THREADING_LAYER_PRIORITY[0] == 'omp'"
    )
    # As numba finds no place beside the sources and none in the home.
    alone = {"NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator", "TMPDIR": str(tmp_path)}
    subprocess.run([sys.executable, "-c", code], env={**os.environ, **alone}, check=True)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_cache_of_types_that_moved_is_compiled_again(tmp_path):
    source = """
from typing import NamedTuple
from gvtools.kernels import compiled

class {name}(NamedTuple):
    x: float

Pair = {name}

@compiled()
def double(pair):
    return 2 * pair.x
"""
    call = "import moved; print(moved.double(moved.Pair(1.5)))"
    for name in ("Before", "Beyond"):
        (tmp_path / "moved.py").write_text(source.format(name=name))
        run = python("-c", call, path=(tmp_path, *sys.path))
        assert run.stdout == "3.0\n", run.stderr
