from __future__ import annotations

import configparser
import os
import re
import subprocess
import sys
from fnmatch import fnmatch
from pathlib import Path

import pytest

import gvtools
from gvtools.system_libraries import LIBRARIES

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


def test_bases_are_pinned_and_one_for_both_stages(steps):
    base = next(value for value in of(steps, "ARG") if value.startswith("BASE="))
    name, _, tag = base.removeprefix("BASE=").rpartition(":")
    assert name and re.match(r"\d+\.\d+", tag)
    assert of(steps, "FROM") == ["${BASE} AS build", "${BASE}"]


def test_what_is_copied_is_there_and_sent(steps):
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


def test_every_install_is_pinned_by_the_constraints(steps):
    installs = [part for value in of(steps, "RUN") for part in value.split("&&")
                if "pip install" in part]  # fmt: skip
    assert len(installs) == 2
    assert all("-c constraints.txt" in part for part in installs)
    extras = next(v for v in of(steps, "ARG") if v.startswith("EXTRAS=")).removeprefix("EXTRAS=")
    assert set(extras.split(",")) <= set(setup()["options.extras_require"])


def test_the_system_libraries_are_all_there(steps):
    last = [name for name, _ in steps].index("FROM", 3)
    installed = " ".join(v for name, v in steps[last:] if name == "RUN" and "apt-get" in v).split()
    assert set(LIBRARIES.values()) <= set(installed)


def test_the_program_runs_as_nobody_in_particular(steps):
    assert of(steps, "USER")[-1].isdecimal() and of(steps, "USER")[-1] != "0"
    assert of(steps, "ENTRYPOINT") == ['["gvtools"]']
    assert "root" not in of(steps, "USER")


def test_torch_comes_from_its_own_index_and_nothing_else_does(steps):
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
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    done = subprocess.run(
        [sys.executable, "-m", "gvtools", "--version"], cwd=tmp_path, text=True,
        env={**os.environ, "PYTHONPATH": path}, capture_output=True,
    )  # fmt: skip
    assert done.returncode == 2 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert str(tmp_path / name) in line and "PYTHONPATH" in line
    script = "import gvtools; gvtools.SpatialMemory; gvtools.reconstruct"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, text=True,
        env={**os.environ, "PYTHONPATH": path}, capture_output=True,
    )  # fmt: skip
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
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "fixtures")])
    done = subprocess.run(
        [sys.executable, "-c", ELSEWHERE, platform, tmp_path], cwd=ROOT, text=True,
        env={**os.environ, "PYTHONPATH": path}, capture_output=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.strip() == ""
    assert (tmp_path / "run" / "memory.npz").is_file()
