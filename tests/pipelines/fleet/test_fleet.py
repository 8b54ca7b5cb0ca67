"""A fleet of scenes: what is run, what is tried again, what is told in the end."""

from __future__ import annotations

import csv
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import pytest
from command_line import is_running, refused

from gvtools.errors import OptionError
from gvtools.runs.folder import folder_lock
from pipelines.cli import main
from pipelines.console import Console
from pipelines.fleet.run import (
    collect,
    lost_worker,
    result_table,
    run_fleet,
    this_machine,
    write_slurm,
)
from pipelines.fleet.spec import FleetSpec, Task, read_list, tasks_of
from pipelines.fleet.task import fetch, read_record, run_task, upload

ROOT = Path(__file__).resolve().parents[3]
# Quick, since it imports neither torch nor numba, and needs no scene.
QUICK = "data list"
LIST = """
stages:
  first: {{command: "{first}", retries: 1}}
  second: {{command: "weights list {{first}}", memory_gb: 0.5}}
scenes: [scans/*]
"""


@pytest.fixture
def scenes(tmp_path):
    for name in ("a", "b", "c"):
        (tmp_path / "scans" / name).mkdir(parents=True)
    (tmp_path / "scans" / "manifest.json").write_text("{}")
    path = tmp_path / "scenes.yaml"
    path.write_text(LIST.format(first="weights list {project}"))
    return path


def quick(scenes: Path) -> None:
    scenes.write_text(LIST.format(first=QUICK).replace("weights list {first}", QUICK))


def planned(path: Path, out: Path) -> list[Task]:
    return tasks_of(read_list(path), str(out), folder=path.parent)


def task_of(tmp_path: Path, command: str, **needs: object) -> Task:
    """The task of a list of one scene and one stage."""
    (tmp_path / "a").mkdir()
    stage = {"command": command, **needs}
    spec = FleetSpec(stages={"stage": stage}, scenes=[{"project": "a"}])
    (task,) = tasks_of(spec, str(tmp_path / "o"), folder=tmp_path)
    return task


def ends_with(monkeypatch, status: int, run: Callable[[Any], object] = str) -> None:
    """Commands of tasks call ``run`` with their words, and end with a status."""

    def ran(command, **_):
        run(command)
        return subprocess.CompletedProcess([], status)

    monkeypatch.setattr("pipelines.fleet.task.subprocess.run", ran)


class Script:
    """A pool that answers from a script: (scene, stage) -> the attempts' records."""

    slots = float("inf")

    def __init__(self, answers: dict) -> None:
        self.answers = answers
        self.begun: list[tuple[str, str, int]] = []

    def submit(self, task, attempt):
        self.begun.append((task.scene, task.stage, attempt))
        return task.scene, task.stage, attempt

    def finished(self, handles):
        scene, stage, attempt = handle = handles[-1]
        done = {"status": "done", "reason": "", "again": False, "seconds": 1.0, "node": "n"}
        found = self.answers.get((scene, stage), [])
        return [(handle, found[attempt - 1] if attempt <= len(found) else done)]

    def close(self) -> None:
        pass


def test_a_pattern_gives_the_folders_that_fit_stage_by_stage(scenes, tmp_path):
    tasks = planned(scenes, tmp_path / "out")
    assert [(t.stage, t.scene) for t in tasks] == [
        (stage, scene) for stage in ("first", "second") for scene in "abc"
    ]
    assert tasks[3].before == ("first",)
    assert tasks[0].project == str(tmp_path / "scans" / "a")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("retries: 1", "retry: 1"), "stages.first.retry"),
        (("{project}", "{second}"), "{second} stands for nothing"),
        (("weights list {project}", "rm -r {project}"), "expected one of demo, capture"),
        (("scans/*", "nowhere/*"), "0 folders fit 'nowhere/*'"),
        (("[scans/*]", "[scans/a, {project: scans/b, name: a}]"), "have this name"),
        (("[scans/*]", "[{project: scans/a, name: ../a}]"), "expected a name of letters"),
        (("scenes:", "rooms:"), "expected the keys"),
    ],
)
def test_a_wrong_list_is_refused_in_one_line(scenes, tmp_path, change, message):
    scenes.write_text(scenes.read_text().replace(*change))
    with pytest.raises(OptionError) as error:
        planned(scenes, tmp_path / "out")
    assert message in str(error.value) and "\n" not in str(error.value)


def test_lost_workers_are_replaced_and_a_failure_skips_what_follows(scenes, tmp_path):
    tasks = planned(scenes, tmp_path / "out")
    wrong = {"status": "failed", "reason": "no cameras", "again": False}
    pool: Any = Script({("a", "first"): [lost_worker("node lost")], ("b", "first"): [wrong],
                          ("c", "second"): [lost_worker("killed")] * 9})  # fmt: skip
    run_fleet(tasks, pool, console=Console(quiet=True))
    assert ("a", "first", 2) in pool.begun and ("a", "second", 1) in pool.begun
    assert ("b", "first", 2) not in pool.begun and ("b", "second", 1) not in pool.begun
    assert [n for scene, stage, n in pool.begun if (scene, stage) == ("c", "second")] == [1, 2, 3]
    records = {(r["scene"], r["stage"]): r for r in collect(tasks)}
    assert records["b", "first"]["reason"] == "no cameras"
    assert records["b", "second"]["reason"] == "stage first failed"
    assert records["c", "second"]["attempts"] == 3
    # The script leaves no records of what it says is done: they are missing, and said so.
    assert records["a", "second"]["status"] == "not run"
    assert len(result_table(collect(tasks)).rows) == 6


def test_a_list_runs_once_and_its_failures_are_told(scenes, tmp_path, capsys):
    quick(scenes)
    out = tmp_path / "out"
    scenes.write_text(scenes.read_text().replace("[scans/*]", "[scans/a]"))
    command = ["fleet", str(scenes), "--engine", "processes", "--out", str(out)]
    first = main(command)
    records = json.loads((out / "results.json").read_text())["tasks"]
    assert [record["stage"] for record in records] == ["first", "second"]
    assert first == 0 and {record["status"] for record in records} == {"done"}
    assert [row["stage"] for row in csv.DictReader((out / "results.csv").open())] == [
        "first", "second"]  # fmt: skip
    assert (out / "a" / "first.log").read_text()
    before = (out / "a" / "first.json").stat().st_mtime_ns
    capsys.readouterr()
    assert main(command) == 0
    assert "finished before" in capsys.readouterr().out
    assert (out / "a" / "first.json").stat().st_mtime_ns == before


def test_a_command_that_was_killed_may_be_tried_again_and_a_wrong_input_not(
    scenes, tmp_path, monkeypatch
):
    task = planned(scenes, tmp_path / "out")[0]

    ends_with(monkeypatch, -signal.SIGKILL)
    record = run_task(task)
    assert (record["reason"], record["again"]) == ("ended by SIGKILL", True)
    ends_with(monkeypatch, 2)
    assert run_task(task)["again"] is False


def test_a_capture_that_ended_before_its_record_is_made_again(tmp_path, monkeypatch):
    """It refuses a folder that is there, and would so fail each time that the fleet goes on."""
    task = task_of(tmp_path, "capture {project} --out {out}")
    out = tmp_path / "o" / "a" / "stage"
    seen = []

    def make(command):
        seen.append(out.exists())
        out.mkdir(parents=True)

    ends_with(monkeypatch, 0, make)
    assert run_task(task)["status"] == "done"
    Path(task.record()).unlink()
    assert run_task(task)["status"] == "done"
    assert seen == [False, False]
    # What no attempt of the fleet has made is never removed.
    Path(task.record()).unlink()
    (tmp_path / "o" / "a" / "stage.log").unlink()
    with pytest.raises(FileExistsError):
        run_task(task)
    assert seen[2:] == [True]


def test_a_merge_goes_on_where_an_attempt_stopped(tmp_path, monkeypatch):
    task = task_of(tmp_path, "merge {project} --out {out}")
    words: list[list[str]] = []

    ends_with(monkeypatch, 1, words.append)
    run_task(task)
    (tmp_path / "o" / "a" / "stage").mkdir()
    run_task(task)
    assert ["--resume" in command for command in words] == [False, True]


@pytest.mark.skipif(sys.platform != "linux", reason="asks the kernel of Linux")
def test_a_command_ends_with_a_driver_that_is_killed(tmp_path):
    driver = subprocess.Popen(
        [sys.executable, "-c", WORKER], stdout=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert driver.stdout is not None
    command = int(driver.stdout.readline())
    driver.kill()
    driver.wait()
    limit = monotonic() + 20
    while is_running(command):
        assert monotonic() < limit, "it goes on without its driver"
        sleep(0.01)
    driver.stdout.close()


# A driver whose thread waits for a command that says its number and would sleep for a minute.
WORKER = """
import os, subprocess, sys
from concurrent.futures import ThreadPoolExecutor
from pipelines.fleet.task import _ending_with

command = [sys.executable, "-c", "import os, time; print(os.getpid(), flush=True); time.sleep(60)"]
pool = ThreadPoolExecutor(1)
pool.submit(subprocess.run, command, preexec_fn=_ending_with(os.getpid())).result()
"""


def test_a_second_driver_of_a_folder_is_refused(scenes, tmp_path, capsys):
    out = tmp_path / "out"
    with folder_lock(out):
        error = refused(capsys, "fleet", scenes, "--engine", "processes", "--out", out)
    assert "another process is at work" in error
    assert list(out.iterdir()) == []


def test_slurm_scripts_run_each_task_and_collect_tells_what_is_missing(scenes, tmp_path, capsys):
    quick(scenes)
    out = tmp_path / "out"
    assert main(["fleet", str(scenes), "--engine", "slurm", "--out", str(out), "--quiet"]) == 0
    scripts = [*out.glob("stage-*.sh"), out / "submit.sh"]
    assert len(scripts) == 3
    for script in scripts:
        subprocess.run(["bash", "-n", str(script)], check=True)
    environment = {**os.environ, "SLURM_ARRAY_TASK_ID": "1", "PYTHONPATH": str(ROOT)}
    subprocess.run(["bash", str(out / "stage-first.sh")], env=environment, check=True)
    record = read_record(f"{out}/b/first.json")
    assert record is not None and record["status"] == "done"
    error = refused(capsys, "fleet", scenes, "--collect", "--out", out)
    assert "5 of 6 tasks are not done" in error
    table = (out / "results.md").read_text()
    assert table.count("not run") == 5


def test_slurm_asks_for_what_a_stage_needs(tmp_path):
    task = task_of(tmp_path, "check {project}", cpus=3, gpus=0.5, memory_gb=1.5)
    write_slurm([task], tmp_path / "o")
    script = (tmp_path / "o" / "stage-stage.sh").read_text()
    for option in ("--cpus-per-task=3", "--gres=gpu:1", "--mem=1500M", "--array=0-0"):
        assert f"#SBATCH {option}\n" in script


def test_a_fleet_at_a_url_reads_and_writes_there(tmp_path, monkeypatch):
    pytest.importorskip("fsspec")
    monkeypatch.setenv("GVTOOLS_FLEET_CACHE", str(tmp_path / "cache"))
    folder, url = tmp_path / "scene", "memory://bucket/scene"
    (folder / "images").mkdir(parents=True)
    contents = {"images/1.bin": bytes(range(256)), "cameras.txt": b"x\n"}
    for name, data in contents.items():
        (folder / name).write_bytes(data)
    upload(folder, url)
    found = fetch(url)
    assert {p.relative_to(found).as_posix(): p.read_bytes() for p in found.rglob("*")
            if p.is_file()} == contents  # fmt: skip
    spec = FleetSpec(stages={"x": {"command": QUICK}}, scenes=[{"project": url}])
    tasks = tasks_of(spec, "memory://bucket/fleet", folder=tmp_path)
    run_fleet(tasks, this_machine(tasks), console=Console(quiet=True))
    [record] = collect(tasks)
    assert (record["scene"], record["status"]) == ("scene", "done")


def test_without_ray_the_engine_says_what_to_install(scenes, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert "gvtools[cluster]" in refused(capsys, "fleet", scenes, "--out", tmp_path / "out")


def test_an_address_without_a_cluster_is_refused_at_once(scenes, tmp_path, capsys):
    pytest.importorskip("ray", reason="ray is not installed")
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{closed.getsockname()[1]}"
        error = refused(capsys, "fleet", scenes, "--out", tmp_path / "out", "--address", address)
    assert "no Ray cluster" in error


@pytest.mark.slow
def test_a_local_ray_cluster_runs_a_list(scenes, tmp_path, monkeypatch):
    pytest.importorskip("ray", reason="ray is not installed")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    # Ray keeps a token there.
    monkeypatch.setenv("HOME", str(tmp_path))
    quick(scenes)
    out = tmp_path / "out"
    main(["fleet", str(scenes), "--out", str(out), "--address", "local"])
    records = json.loads((out / "results.json").read_text())["tasks"]
    assert len(records) == 6 and {record["status"] for record in records} == {"done"}
