"""The Taichi runtime: started once, late, quietly, with the right threads; refused after a fork."""

from __future__ import annotations

import ast
import math
import multiprocessing
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, Literal

import pytest

from sdc_taichi import Drivers, RuntimeStateError, Simulator, drivers_from_arrays, load_config
from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.kernels.compiler.runtime import processor_quota, uses_plain_taichi


def run_python(code: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run code in another process, with environment variables besides those of this one."""
    return subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def short_drivers() -> Drivers:
    return drivers_from_arrays([20.0] * 8, [15.0] * 8, [300.0] * 8, [0.5] * 8)


def child_step(queue: Any) -> None:
    """Run a step in another process and tell how it ended."""
    try:
        with Simulator(load_config("tiny"), drivers=short_drivers()) as sim:
            sim.reset()
            queue.put(("done", float(sim.step().it_w[0])))
    except RuntimeStateError as error:
        queue.put(("refused", str(error)))


def run_child(method: Literal["fork", "spawn"]) -> tuple[str, Any]:
    context: Any = multiprocessing.get_context(method)
    queue = context.Queue()
    process = context.Process(target=child_step, args=(queue,))
    process.start()
    try:
        answer: tuple[str, Any] = queue.get(timeout=60)
        process.join(60)
        assert process.exitcode == 0
    finally:
        if process.is_alive():
            process.kill()
    return answer


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_a_forked_worker_is_refused_and_a_spawned_one_works() -> None:
    with Simulator(load_config("tiny"), drivers=short_drivers()) as sim:
        sim.reset()
        here = float(sim.step().it_w[0])
    kind, text = run_child("fork")
    assert kind == "refused"
    assert "forked after Taichi started" in text
    assert "spawn" in text
    assert run_child("spawn") == ("done", here)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
@pytest.mark.parametrize("use", ["step", "servers", "new", "close"])
def test_a_simulator_in_a_forked_child_never_hangs(use: str) -> None:
    sim = Simulator(load_config("tiny"), drivers=short_drivers())
    sim.reset()
    sim.step()
    pid = os.fork()
    if pid == 0:
        signal.alarm(30)
        code = 1
        try:
            if use == "new":
                Simulator(load_config("tiny"), drivers=short_drivers()).reset()
            else:
                getattr(sim, use)()
            code = 0
        except RuntimeStateError:
            code = 2
        finally:
            os._exit(code)
    _, status = os.waitpid(pid, 0)
    assert os.waitstatus_to_exitcode(status) == (0 if use == "close" else 2)
    assert sim.step().step == 1, "the parent goes on"
    sim.close()


def test_creating_a_simulator_starts_no_runtime() -> None:
    code = (
        "import sys, time; t = time.perf_counter(); import sdc_taichi as s;"
        "sim = s.Simulator(s.load_config('tiny'),"
        " drivers=s.drivers_from_arrays([20.], [15.], [300.], [.5]));"
        "assert 'taichi' not in sys.modules; sim.reset(); assert 'taichi' in sys.modules;"
        "import taichi; assert not sys.stdout.tell() if sys.stdout.seekable() else True"
    )
    done = run_python(code)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "", "Taichi's banner reached standard output"


def test_nothing_is_printed_where_standard_output_is_replaced() -> None:
    """As in notebooks, where Taichi says that there is one."""
    code = (
        "import io, sys; sys.stdout = io.StringIO(); import sdc_taichi as s;"
        "sim = s.Simulator(s.load_config('tiny'),"
        " drivers=s.drivers_from_arrays([20.], [15.], [300.], [.5]));"
        "sim.reset(); sim.step(); sys.__stdout__.write(sys.stdout.getvalue())"
    )
    done = run_python(code)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="the system binds no threads")
@pytest.mark.skipif(uses_plain_taichi(), reason="plain Taichi leaves threads to the system")
def test_as_many_threads_as_processors_are_bound_to_one_each() -> None:
    processors = sorted(os.sched_getaffinity(0))
    code = (
        "import os; from sdc_taichi.kernels.compiler import runtime; runtime.ensure_started();"
        "print([sorted(os.sched_getaffinity(int(t))) for t in os.listdir('/proc/self/task')])"
    )
    for threads in (len(processors), len(processors) + 1):
        done = run_python(code, SDC_TAICHI_THREADS=str(threads))
        allowed = ast.literal_eval(done.stdout)
        assert processors in allowed
        if threads == len(processors):
            assert all([one] in allowed for one in processors)
        else:
            assert all(bound == processors for bound in allowed)


@pytest.mark.parametrize(
    "limit",
    [
        "import os; os.sched_setaffinity(0, list(os.sched_getaffinity(0))[:1])",
        "runtime.processor_quota = lambda: 1",
    ],
)
def test_there_are_no_more_threads_than_processors_may_be_used(limit: str) -> None:
    if "affinity" in limit and not hasattr(os, "sched_setaffinity"):
        pytest.skip("the system binds no processes")
    code = (
        f"from sdc_taichi.kernels.compiler import runtime; {limit}; print(runtime.ensure_started())"
    )
    assert run_python(code, SDC_TAICHI_THREADS="").stdout.split() == ["1"]


@pytest.mark.parametrize(
    ("groups", "settings", "expected"),
    [
        ("0::/", {"cpu.max": "max 100000"}, math.inf),
        ("0::/", {"cpu.max": "150000 100000"}, 2),
        ("0::/docker/1f2e", {"cpu.max": "50000 100000"}, 1),
        ("0::/jobs/7", {"jobs/7/cpu.max": "800000 100000", "jobs/cpu.max": "300000 100000"}, 3),
        (
            "3:cpuset:/\n2:cpu,cpuacct:/docker/1f2e",
            {"cpu/cpu.cfs_quota_us": "400000", "cpu/cpu.cfs_period_us": "100000"},
            4,
        ),
        ("0::/", {"cpu.max": "1000 100000"}, 1),
        ("0::/", {"cpu.max": "100000 0"}, math.inf),
        ("0::/", {"cpu.max": "much"}, math.inf),
        ("0::/a\0b\nnone\n\n0", {}, math.inf),
        ("1:cpu:/", {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, math.inf),
        (None, {}, math.inf),
    ],
)
def test_quotas_of_control_groups_are_read(
    groups: str | None, settings: dict[str, str], expected: float, tmp_path: Path
) -> None:
    told, mounted = tmp_path / "groups", tmp_path / "mounted"
    if groups is not None:
        told.write_text(f"{groups}\n")
    for name, text in settings.items():
        (mounted / name).parent.mkdir(parents=True, exist_ok=True)
        (mounted / name).write_text(f"{text}\n")
    assert processor_quota(told, mounted) == expected


def test_several_threads_may_start_first() -> None:
    code = """
import threading
from sdc_taichi import Simulator, load_config

def run():
    with Simulator(load_config("tiny")) as sim:
        sim.reset()
        found.append(sim.step().grid_kwh[0])

found = []
threads = [threading.Thread(target=run) for _ in range(4)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print(*found)
"""
    found = run_python(code).stdout.split()
    assert len(found) == 4
    assert len(set(found)) == 1


def test_another_user_of_taichi_may_have_chosen_other_literals() -> None:
    code = (
        "import taichi as ti\n"
        "ti.init(arch=ti.cpu, default_ip=ti.i64, default_fp=ti.f64, log_level=ti.ERROR,"
        f" offline_cache_max_size_of_files={runtime.KERNELS_BYTES})\n"
        "from sdc_taichi import Simulator, load_config\n"
        "sim = Simulator(load_config('tiny'))\n"
        "sim.reset()\n"
        "print(sim.step().it_w.tobytes().hex(), ti.cfg.default_ip == ti.i64)\n"
    )
    done = run_python(code)
    if uses_plain_taichi():
        assert "started with default_ip=i64; valid with SDC_TAICHI_PLAIN=1 is i32" in done.stderr
        return
    with Simulator(load_config("tiny")) as sim:
        sim.reset()
        expected = f"{sim.step().it_w.tobytes().hex()} True"
    assert done.stdout.splitlines()[-1] == expected


def test_a_home_that_cannot_be_written_and_foreign_variables_change_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "temporary").mkdir()
    code = """
import os
from sdc_taichi.kernels.compiler import runtime
runtime.ensure_started()
import taichi as ti

@ti.kernel
def double(x: ti.f64) -> ti.f64:
    return 2.0 * x

print(double(21.0), ti.cfg.arch == ti.cpu, ti.cfg.debug)
print(os.environ["TI_ARCH"], "HOME" in os.environ)
"""
    (tmp_path / "script.py").write_text(code)
    environment = {k: v for k, v in os.environ.items() if k not in ("HOME", "XDG_CACHE_HOME")}
    environment |= {
        "TI_OFFLINE_CACHE_FILE_PATH": str(tmp_path / "file" / "cache"),
        "TI_ARCH": "abacus",
        "TI_DEBUG": "much",
        "TI_LOG_LEVEL": "loud",
        "TI_DEFAULT_FP": "7",
        "TMPDIR": str(tmp_path / "temporary"),
    }
    done = subprocess.run(
        [sys.executable, tmp_path / "script.py"],
        env=environment, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert (done.stdout, done.returncode) == ("42.0 True False\nabacus False\n", 0), done.stderr
    assert done.stderr.count("Warning:") == 1
    said = f"{tmp_path / 'file' / 'cache'}: cannot be written (Not a directory); kernels are"
    assert f"KernelCacheWarning: {said} compiled in every process\n" in done.stderr
    assert list((tmp_path / "temporary").iterdir()) == []


def test_a_lock_that_a_killed_process_left_among_the_kernels_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock = tmp_path / "ticache.lock"
    monkeypatch.setenv("TI_OFFLINE_CACHE_FILE_PATH", str(tmp_path))
    lock.write_bytes(b"")
    assert runtime.kernel_folder() == tmp_path
    assert lock.exists(), "a lock of this moment is that of a process that runs"
    os.utime(lock, (0, 0))
    runtime.kernel_folder()
    assert not lock.exists()
