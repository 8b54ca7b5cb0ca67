"""No file that gvtools reads may run code: no pickle, no YAML objects, no eval."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = ("gvtools", "pipelines", "viz", "benchmarks", "examples", "tools", "data_specs")
FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
# A function that goes to a process of our own over a pipe, to compile kernels there.
OWN_PIPE = {"gvtools/kernels.py"}
# Its exceptions are caught by name; torch itself unpickles, weights only.
ERRORS_ALONE = {"gvtools/networks/tensors.py"}
MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "jsonpickle"}
CALLS = {"load", "loads", "eval", "exec", "unsafe_load", "full_load", "read_pickle", "safe_load",
         "safe_load_all"}  # fmt: skip
OPTIONS = {"allow_pickle", "weights_only"}


def complaints(source: str, name: str = "x.py") -> list[str]:
    """What a module's source does that could run what a file says."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            modules = (
                [a.name for a in node.names] if isinstance(node, ast.Import) else [node.module]
            )
            bad = {str(module).split(".")[0] for module in modules} & MODULES
            if bad and name not in OWN_PIPE | ERRORS_ALONE:
                found.append(f"{name}:{node.lineno} imports {bad}")
        if not isinstance(node, ast.Call):
            continue
        said = {k.arg: ast.unparse(k.value) for k in node.keywords if k.arg in OPTIONS}
        if not said and getattr(node.func, "attr", getattr(node.func, "id", "")) not in CALLS:
            continue
        called = ast.unparse(node.func)
        where = f"{name}:{node.lineno} {called}"
        if called in ("np.load", "numpy.load") and said.get("allow_pickle") != "False":
            found.append(f"{where} without allow_pickle=False")
        if said.get("allow_pickle", "False") != "False":
            found.append(f"{where} allows pickle")
        if called == "torch.load" and said.get("weights_only") != "True":
            found.append(f"{where} without weights_only=True")
        if called in ("eval", "exec", "yaml.load", "yaml.unsafe_load", "yaml.full_load"):
            found.append(where)
        if called in ("pickle.load", "pickle.loads", "pd.read_pickle"):
            found.append(where)
        if called in ("yaml.safe_load", "yaml.safe_load_all") and name != "gvtools/untrusted.py":
            found.append(f"{where}; use gvtools.untrusted.parse_yaml")
    return found


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from joblib import load",
        "np.load(path)",
        "np.load(path, allow_pickle=True)",
        "np.save(path, x, allow_pickle=True)",
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "eval(text)",
        "yaml.load(text, Loader=yaml.Loader)",
        "yaml.safe_load(text)",
    ],
)
def test_the_check_finds_what_it_looks_for(source):
    assert complaints(source)


def test_sound_calls_pass_the_check():
    sound = "np.load(p, allow_pickle=False); torch.load(p, weights_only=True); model.eval()"
    assert complaints(sound) == []


def test_no_file_is_unpickled_or_run():
    assert len(FILES) > 300
    names = [path.relative_to(ROOT).as_posix() for path in FILES]
    found = [
        complaint
        for path, name in zip(FILES, names, strict=True)
        for complaint in complaints(path.read_text(encoding="utf-8"), name)
    ]
    assert found == []
    assert set(names) >= OWN_PIPE | ERRORS_ALONE  # no exception outlives its reason
