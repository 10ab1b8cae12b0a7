"""The steps of setup/gpu_trial.sh: tests and measures the harness on a GPU, and compares it with PyTorch there.

    python3 harness/benches/gpu.py STEP

gpu_trial.sh sets the environment: TRIAL is a folder for temporary files that contains the programs, OUT one for the
results, and LIBRARIES lists the folders of the programs' libraries.

Each measurement is a median: of blocks of 20 training steps, or of epochs. A ratio above 1 means that the harness is
faster than the contender at the same precision. The harness has no bf16 on a GPU, so bf16 is compared with its tf32.
"""

import contextlib
import datetime
import functools
import json
import os
import platform
import shlex
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import report

BENCHES = Path(__file__).parent
TRIAL, OUT = Path(os.environ.get("TRIAL", "/tmp/gpu_trial")), Path(os.environ.get("OUT", "out"))
HARNESS = TRIAL / "bin" / "harness"
# The programs and the scripts run on the GPU, unless this says cpu, which tests this program without a GPU.
DEVICE = os.environ.get("DEVICE", "cuda")
EPISODES = int(os.environ.get("EPISODES", "40"))
# Only training steps and epochs whose name contains this are measured.
MATCH = os.environ.get("MATCH", "")

COLUMNS = (
    ("what", "text", "", "what was measured"),
    ("contender", "text", "", "the measured program and its settings"),
    ("precision", "text", "", "f32, tf32 or bf16"),
    ("seconds", "real", "s", "median"),
    ("ratio", "real", "1", "seconds of the contender divided by those of the harness; null without the harness"),
    ("batch", "integer", "1", "samples in a training step; null for anything else"),
    ("card", "text", "", "the GPU"),
    ("driver", "text", "", "version of the GPU's driver"),
    ("torch", "text", "", "version of PyTorch"),
    ("cuda", "text", "", "version of CUDA that PyTorch was built with"),
    ("processor", "text", "", "the machine's processor"),
    ("cores", "integer", "1", "processors that the contenders could use"),
    ("harness_version", "text", "", "version of the harness"),
    ("date", "text", "", "when it was measured, UTC"),
)
METRIC_COLUMNS = (
    ("precision", "text", "", "f32 or tf32, on the GPU; the CPU's is f32"),
    ("metric", "text", "", "name of the metric"),
    ("modality", "text", "", "what is predicted"),
    ("unit", "text", "", "unit of the metric"),
    ("difference", "real", "", "largest difference between the GPU and the CPU over all runs"),
    ("magnitude", "real", "", "largest magnitude of the metric on the CPU"),
    ("card", "text", "", "the GPU"),
)

# Layers, and options of both training_step programs. The paper's network is that of experiments/reproduction.yaml.
DEEP = ("--channels", 8, 16, 32, 32, "--fusion", "late", "--hidden", 256, "--latent", 64)
PAPER = ("--channels", 4, "--hidden", 256, 256, "--latent", 64)
VECTORS = ("--hidden", 256, "--latent", 4)
SEQUENCES = ("--context", 50, "--hidden", 256, "--latent", 64)
# The harness's settings for the same networks.
DEEP_SPEC = ("multi_to_multi", "network.fusion=late", "network.channels=[8,16,32,32]", "network.hidden=[256]")
PAPER_SPEC = ("multi_to_multi", "network.channels=[4]", "network.hidden=[256,256]")

MODES = ("eager", "compile", "graph", "compiled-graph")
PRECISIONS = ("f32", "tf32") if DEVICE == "cuda" else ("f32",)
IN_ALL = ("--precision", *PRECISIONS)
# Settings of PyTorch for networks with images.
CAMERA = ("--mode", *MODES, "--memory-format", "channels_last", *IN_ALL)
CONTIGUOUS = ("--mode", "graph", "compiled-graph", "--memory-format", "contiguous", *IN_ALL)
# Name, layers, batch, and the settings of PyTorch.
STEPS = (
    ("deep", DEEP, 1024, [CAMERA, CONTIGUOUS]),
    ("deep", DEEP, 256, [CAMERA]),
    ("paper's", PAPER, 1024, [CAMERA]),
    ("vectors", VECTORS, 1024, [("--mode", *MODES, *IN_ALL)]),
    (
        "gated recurrent unit",
        ("--memory", "gru", *SEQUENCES),
        1000,
        [("--mode", *MODES, *IN_ALL)],
    ),
    (
        "state-space model",
        ("--memory", "rssm", *SEQUENCES),
        1000,
        [("--mode", "eager", "graph", *IN_ALL)],
    ),
)
EPOCHS = (("deep", DEEP, DEEP_SPEC, 256), ("deep", DEEP, DEEP_SPEC, 1024), ("paper's", PAPER, PAPER_SPEC, 1024))


class Failure(Exception):
    """Something failed; the message says what."""


failures = 0


@contextlib.contextmanager
def attempt(what: str) -> Iterator[None]:
    """Reports an error, and goes on."""
    global failures
    try:
        yield
    except Exception as error:
        failures += 1
        if not isinstance(error, Failure):
            traceback.print_exc()
        print(f"FAILED {what}: {error}")


def environment() -> dict[str, str]:
    return os.environ | {"LD_LIBRARY_PATH": os.environ.get("LIBRARIES", "")}


def last_lines(text: str, count: int = 12) -> str:
    return "\n".join(f"    {line[:300]}" for line in text.strip().splitlines()[-count:])


def run(*command, seconds: float = 300, code: int | None = 0, env: dict | None = None) -> subprocess.CompletedProcess:
    """Runs a command. Fails unless it ends in time and with this code, if there is one."""
    command = [str(part) for part in command]
    begin = time.perf_counter()
    try:
        done = subprocess.run(command, capture_output=True, check=False, text=True, timeout=seconds, env=env)
    except subprocess.TimeoutExpired as error:
        parts = [part for part in (error.stdout, error.stderr) if part]
        said = "".join(part if isinstance(part, str) else part.decode(errors="replace") for part in parts)
        raise Failure(f"{shlex.join(command)} took more than {seconds} s\n{last_lines(said)}") from None
    print(f"$ {shlex.join(command)}   ({time.perf_counter() - begin:.1f} s, code {done.returncode})")
    if code is not None and done.returncode != code:
        raise Failure(f"it ended with {done.returncode}\n{last_lines(done.stdout + done.stderr)}")
    return done


def harness(results: Path, *arguments, **options) -> subprocess.CompletedProcess:
    return run(HARNESS, "--results", results, *arguments, env=environment(), **options)


def query(results: Path, sql: str) -> list[dict]:
    return json.loads(harness(results, "query", sql, "--format", "json").stdout)


def results(name: str) -> Path:
    """An empty folder of results with all datasets so far."""
    folder = TRIAL / "results" / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    shutil.copytree(datasets(), folder / "datasets", copy_function=os.link)
    return folder


def datasets() -> Path:
    """The folder of the datasets, at first of those that were packed."""
    folder = TRIAL / "shared" / "datasets"
    if not folder.exists():
        packed = BENCHES.parents[1] / "datasets"
        if packed.exists():
            shutil.copytree(packed, folder)
        else:
            folder.mkdir(parents=True)
    return folder


def collect(*settings) -> None:
    """Collects what is missing of an experiment's datasets."""
    print(last_lines(harness(datasets().parent, "collect", *settings, seconds=200).stdout, 3))


# The table


def measure_machine() -> dict:
    card, driver = "none", "none"
    if DEVICE == "cuda":
        told = run("nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader").stdout
        card, driver = told.strip().splitlines()[0].split(", ")
    versions = "import json, torch; print(json.dumps([torch.__version__, torch.version.cuda]))"
    torch, cuda = json.loads(run(sys.executable, "-c", versions).stdout)
    version = run(HARNESS, "--version", env=environment()).stdout.split()[-1]
    return {
        "card": card,
        "driver": driver,
        "torch": torch,
        "cuda": cuda,
        "processor": report.processor(),
        "cores": report.cores(),
        "harness_version": version,
    }


@functools.cache
def this_machine() -> dict:
    file = TRIAL / "machine.json"
    if not file.exists():
        file.write_text(json.dumps(measure_machine()))
    return json.loads(file.read_text())


def write(what: str, batch: int | None, ours: dict[str, float], others: list[tuple[str, str, float]]) -> None:
    """Writes the harness's seconds by precision, and those of contenders with their names and precisions."""
    rows = [("harness", precision, seconds) for precision, seconds in ours.items()] + others
    date = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    written = []
    for contender, precision, seconds in rows:
        harness_seconds = ours.get("tf32" if precision == "bf16" else precision)
        ratio = None if harness_seconds is None else seconds / harness_seconds
        found = {"what": what, "contender": contender, "precision": precision, "seconds": seconds, "ratio": ratio}
        written.append(found | {"batch": batch, "date": date} | this_machine())
        shown = "" if ratio is None else f"{ratio:.2f}"
        print(f"| {what} | {contender} | {precision} | {report.quantity(seconds, 's')} | {shown} |")
    report.write_rows(OUT / "gpu.parquet", written, COLUMNS)


# PyTorch and the harness


def pytorch(script: str, *options, seconds: float = 300) -> list[dict]:
    """Returns what a script prints for each combination of settings, even if it fails after some of them."""
    command = [sys.executable, str(BENCHES / script), "--device", DEVICE, *map(str, options)]
    print(f"$ {shlex.join(command)}")
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        try:
            subprocess.run(command, check=False, stdout=out, stderr=err, timeout=seconds)
        except subprocess.TimeoutExpired:
            print(f"    took more than {seconds} s")
        out.seek(0)
        err.seek(0)
        told = [json.loads(line) for line in out if line.startswith("{") and line.endswith("}\n")]
        if not told:
            raise Failure(f"PyTorch said nothing\n{last_lines(err.read())}")
    for one in told:
        if "error" in one:
            print(f"    {contender(one)}, {one['precision']}: {one['error'][:300]}")
    return [one for one in told if "error" not in one]


def contender(told: dict) -> str:
    parts = ["PyTorch " + told["mode"]]
    parts += [told["memory_format"].replace("_", " ")] if told.get("channels") else []
    parts += ["nn.GRU" if told["recurrence"] == "module" else "GRUCell"] if told.get("memory") == "gru" else []
    return ", ".join(parts)


def others(told: list[dict]) -> list[tuple[str, str, float]]:
    return [(contender(one), one["precision"], one["median_seconds"]) for one in told]


def harness_step(*options) -> float:
    done = run(TRIAL / "bin" / "training_step", "--device", DEVICE, *options, seconds=60, env=environment())
    return json.loads(done.stdout.strip().splitlines()[-1])["median_seconds"]


# Steps


def machine() -> None:
    """Prints what there is, and which libraries the programs lack."""
    (TRIAL / "machine.json").unlink(missing_ok=True)
    with attempt("libraries"):
        for program in (HARNESS, TRIAL / "bin" / "training_step"):
            found = run("ldd", program, env=environment()).stdout
            missing = [line for line in found.splitlines() if "not found" in line]
            if missing:
                raise Failure("\n".join(missing))
    with attempt("machine"):
        print(json.dumps(this_machine()), platform.platform())
    with attempt("nvidia-smi"):
        print(run("nvidia-smi").stdout)


def prepare() -> None:
    """Compiles PyTorch's networks for later steps, which find them in the compiler's cache."""
    jobs = []
    for _, layers, batch, settings in STEPS:
        modes = [mode for mode in ("compile", "reduce-overhead") if mode in settings[0]] or ["compile"]
        for layout in ("channels_last", "contiguous") if "--channels" in layers else ("contiguous",):
            for precision in PRECISIONS:
                way = ("--mode", *modes, "--memory-format", layout, "--precision", precision)
                jobs.append(("training_step.py", *layers, "--batch", batch, *way, "--steps", 1))
    for _, layers, _, batch in EPOCHS:
        for precision in PRECISIONS:
            way = ("--mode", "compile", "--memory-format", "channels_last", "--precision", precision)
            jobs.append(("epoch.py", *layers, "--batch", batch, *way, "--epochs", 1, "--episodes", EPISODES))
    os.environ["TORCHINDUCTOR_COMPILE_THREADS"] = "2"

    def job(options: tuple) -> None:
        with attempt(f"preparing {options}"):
            pytorch(*options, seconds=270)

    # The state-space model takes the longest.
    jobs.sort(key=lambda options: "rssm" not in options)
    with ThreadPoolExecutor(max(2, report.cores() // 2)) as pool:
        list(pool.map(job, jobs))
    # The compiler measured variants of its kernels while the GPU was busy. It does so again when they are timed.
    for file in Path(os.environ["TORCHINDUCTOR_CACHE_DIR"]).rglob("*.best_config"):
        file.unlink()


def ops() -> None:
    """Every op and every kind of network on the GPU, compared with the CPU."""
    with attempt("ops"):
        done = run(TRIAL / "bin" / "ops_on_gpu", "--nocapture", "--test-threads", 1, seconds=230, code=None,
                   env=environment())
        print(done.stdout)
        if done.returncode:
            raise Failure(f"it ended with {done.returncode}\n{last_lines(done.stderr, 60)}")


VALUES = (
    "select scenario, seed, task, modality, direction, index, metric, unit, value from metrics where model = 'network'"
)


def metrics(folder: Path) -> dict[tuple, float | None]:
    rows = query(folder, VALUES)
    if not rows:
        raise Failure(f"{folder} has no metrics")
    return {tuple(value for name, value in row.items() if name != "value"): row["value"] for row in rows}


def smoke() -> None:
    """Every stage on the GPU, and the differences of the metrics from the CPU's over three seeds."""
    with attempt("smoke"):
        with attempt("collecting"):
            collect("smoke")
        settings = ("smoke", "seeds=[0,1,2]")
        cpu = results("smoke-cpu")
        harness(cpu, "run", *settings, "training.device=cpu")
        expected = metrics(cpu)
        for precision in PRECISIONS:
            gpu = results(f"smoke-{precision}")
            harness(gpu, "run", *settings, f"training.device={DEVICE}", f"training.precision={precision}")
            write_differences(precision, metrics(gpu), expected)


def write_differences(precision: str, found: dict[tuple, float | None], expected: dict[tuple, float | None]) -> None:
    if found.keys() != expected.keys():
        raise Failure(f"other metrics: {sorted(found.keys() ^ expected.keys(), key=str)[:5]}")
    largest = {}
    for key, value in expected.items():
        *_, modality, _, _, metric, unit = key
        if (value is None) != (found[key] is None):
            raise Failure(f"{key} is {found[key]} instead of {value}")
        if value is not None:
            difference, magnitude = largest.get((metric, modality, unit), (0.0, 0.0))
            largest[metric, modality, unit] = max(difference, abs(value - found[key])), max(magnitude, abs(value))
    rows = []
    for (metric, modality, unit), (difference, magnitude) in sorted(largest.items()):
        print(f"{precision} {metric} {modality}: differs by {difference:.3g} {unit}, is at most {magnitude:.4g}")
        rows.append(
            {"precision": precision, "metric": metric, "modality": modality, "unit": unit}
            | {"difference": difference, "magnitude": magnitude, "card": this_machine()["card"]}
        )
    report.write_rows(OUT / "gpu_metrics.parquet", rows, METRIC_COLUMNS)


# A training of several seconds on a GPU.
LONG_EPOCHS = 1500
LONG = ("smoke", "scenarios=[empty]", f"training.device={DEVICE}", f"training.epochs={LONG_EPOCHS}",
        "training.patience=null")  # fmt: skip


@functools.cache
def uninterrupted() -> Path:
    with attempt("collecting"):
        collect("smoke")
    folder = TRIAL / "results" / "uninterrupted"
    complete = folder / "complete"
    if not complete.exists():
        harness(results("uninterrupted"), "run", *LONG)
        complete.touch()
    return folder


def same_as_uninterrupted(folder: Path) -> None:
    """Metrics and networks must be the same bit for bit."""
    whole = uninterrupted()
    if metrics(folder) != metrics(whole):
        raise Failure(f"{folder} has other metrics than {whole}")
    for file in whole.glob("runs/*/*/*.safetensors"):
        if (folder / file.relative_to(whole)).read_bytes() != file.read_bytes():
            raise Failure(f"{file.relative_to(whole)} of {folder} differs")
    print(f"{folder.name}: metrics and networks are the same bit for bit")


def start(folder: Path) -> subprocess.Popen:
    command = [str(part) for part in (HARNESS, "--results", folder, "run", *LONG)]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment()
    )


def interrupt() -> None:
    """A run that is stopped and killed, and continues."""
    with attempt("interrupt"):
        uninterrupted()
        folder = results("interrupted")
        for number, code in ((signal.SIGINT, 130), (signal.SIGKILL, -9)):
            process = start(folder)
            least = LONG_EPOCHS // 4 if number == signal.SIGINT else LONG_EPOCHS // 2
            while process.poll() is None and epochs_done(folder) < least:
                time.sleep(0.1)
            done = epochs_done(folder)
            process.send_signal(number)
            said, _ = process.communicate(timeout=60)
            print(f"{number.name} after {done} epochs: code {process.returncode}\n{last_lines(said, 4)}")
            if process.returncode != code:
                raise Failure(f"the code is not {code}")
        harness(folder, "run", *LONG)
        same_as_uninterrupted(folder)


def epochs_done(folder: Path) -> int:
    """Of the prediction, while the run goes on."""
    sql = "select max(epoch) as epoch from epochs where task = 'prediction'"
    with contextlib.suppress(Failure), contextlib.redirect_stdout(None):
        return query(folder, sql)[0]["epoch"] or 0
    return 0


def two() -> None:
    """Two processes that train at the same time on one GPU."""
    with attempt("two"):
        uninterrupted()
        folders = [results("one"), results("other")]
        for process in [start(folder) for folder in folders]:
            said, _ = process.communicate(timeout=90)
            if process.returncode:
                raise Failure(f"it ended with {process.returncode}\n{last_lines(said)}")
        for folder in folders:
            same_as_uninterrupted(folder)


HOLD = """
import sys, torch
torch.zeros(1, device="cuda")
free, _ = torch.cuda.mem_get_info()
held = torch.empty(free - int(sys.argv[1]) * 2**20, dtype=torch.uint8, device="cuda")
print(torch.cuda.mem_get_info()[0] // 2**20, flush=True)
sys.stdin.read()
"""


def memory() -> None:
    """A run that lacks memory on the GPU ends with a message, and succeeds later."""
    with attempt("collecting"):
        collect("smoke")
    # With so wide a layer, the parameters and the optimizer's state take a gigabyte.
    settings = ("smoke", "scenarios=[empty]", f"training.device={DEVICE}", "network.hidden=[8000]")
    folder = results("memory")
    for left in (100, 300, 700, 1200):
        with attempt(f"{left} MiB left"):
            holder = subprocess.Popen(
                [sys.executable, "-c", HOLD, str(left)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
            try:
                free = holder.stdout.readline().strip()
                if not free:
                    raise Failure("the GPU's memory can't be filled")
                print(f"{free} MiB are left on the GPU")
                done = harness(folder, "run", *settings, seconds=60, code=None)
            finally:
                holder.communicate()
            print(last_lines(done.stderr, 20))
            if done.returncode != 1 or "panicked" in done.stderr:
                raise Failure(f"the run ended with {done.returncode}, or panicked")
    with attempt("enough memory"):
        harness(folder, "run", *settings, seconds=60)


def dataset() -> tuple[str, ...]:
    """Collects 40,000 samples unless they are there, and returns the settings of the dataset."""
    settings = ("scenarios=[empty]", f"simulation.episodes={EPISODES}", "simulation.actuations_per_episode=100")
    collect("multi_to_multi", *settings)
    return settings


def render() -> None:
    """Which device renders, and the speed of collecting."""
    with attempt("doctor"):
        print(harness(TRIAL / "shared", "doctor", code=None).stdout)
    for threads in sorted({1, report.cores(), 2 * report.cores()}):
        with attempt(f"collect with {threads} threads"):
            episodes, folder = max(3, 2 * threads), TRIAL / "results" / "collected"
            shutil.rmtree(folder, ignore_errors=True)
            settings = ("multi_to_multi", "scenarios=[empty]", f"simulation.episodes={episodes}")
            begin = time.perf_counter()
            harness(folder, "collect", *settings, "--threads", threads, seconds=100)
            each = (time.perf_counter() - begin) / episodes / 1000
            write(f"collection of a sample, {threads} threads", None, {"f32": each}, [])
    with attempt("dataset"):
        dataset()


def steps() -> None:
    """Training steps, compared with PyTorch."""
    for name, layers, batch, settings in STEPS:
        what = f"training step, {name}, batch {batch}"
        if MATCH not in what:
            continue
        with attempt(what):
            work = (*layers, "--batch", batch, "--steps", 200, "--block", 20)
            rounds = {precision: [] for precision in PRECISIONS}

            def measure_ours(rounds=rounds, work=work) -> None:
                for precision, seconds in rounds.items():
                    with attempt(f"harness, {precision}"):
                        seconds.append(harness_step(*work, "--precision", precision))

            measure_ours()
            found = []
            for options in settings:
                with attempt(f"{what}, PyTorch"):
                    found += others(pytorch("training_step.py", *work, *options, seconds=200))
            measure_ours()
            ours = {precision: statistics.median(seconds) for precision, seconds in rounds.items() if seconds}
            write(what, batch, ours, found)


def autotune() -> None:
    """A training step of the deep network with PyTorch's longest search for fast kernels, which takes minutes."""
    with attempt("autotune"):
        work = (*DEEP, "--batch", 1024, "--steps", 200, "--block", 20)
        ours = {"tf32": harness_step(*work, "--precision", "tf32")}
        way = ("--mode", "max-autotune", "--memory-format", "channels_last", "--precision", "tf32")
        found = others(pytorch("training_step.py", *work, *way))
        write("training step, deep, batch 1024, autotuned", 1024, ours, found)


def harness_epoch(folder: Path, *settings) -> float:
    harness(folder, "run", *settings, "latent=64", "seeds=0", "tasks=[prediction]", "training.patience=null",
            f"training.device={DEVICE}", "training.epochs=6", seconds=120)  # fmt: skip
    times = query(folder, "select epoch, max(seconds) as seconds from epochs group by epoch order by epoch")
    # The first epoch copies the dataset to the GPU.
    return statistics.median(row["seconds"] for row in times[1:])


def fastest(what: str, precision: str) -> tuple[str, str]:
    """The fastest mode and memory format of PyTorch in a training step that was measured before."""
    import pyarrow.parquet

    with contextlib.suppress(OSError):
        rows = pyarrow.parquet.read_table(OUT / "gpu.parquet").to_pylist()
        rows = [row for row in rows if row["what"] == what and row["precision"] == precision]
        rows = [row for row in rows if row["contender"].startswith("PyTorch ")]
        if rows:
            mode, layout = min(rows, key=lambda row: row["seconds"])["contender"].removeprefix("PyTorch ").split(", ")
            return mode, layout.replace(" ", "_")
    return "compiled-graph", "channels_last"


def epochs() -> None:
    """Epochs over 40,000 samples with images, compared with PyTorch eager, compiled and at its fastest."""
    settings = None
    with attempt("dataset"):
        settings = dataset()
    for name, layers, spec, batch in EPOCHS:
        what = f"epoch of {EPISODES * 1000} samples, {name}, batch {batch}"
        if MATCH not in what:
            continue
        ours, found = {}, []
        for precision in PRECISIONS:
            with attempt(f"{what}, harness, {precision}"):
                if settings is None:
                    raise Failure("there is no dataset")
                folder = results("epochs")
                ours[precision] = harness_epoch(folder, *spec, *settings, f"training.batch_size={batch}",
                                                f"training.precision={precision}")  # fmt: skip
            with attempt(f"{what}, PyTorch, {precision}"):
                mode, layout = fastest(f"training step, {name}, batch {batch}", precision)
                modes = dict.fromkeys(("eager", "compile", mode))
                work = (*layers, "--batch", batch, "--episodes", EPISODES)
                way = ("--mode", *modes, "--memory-format", layout, "--precision", precision)
                found += others(pytorch("epoch.py", *work, *way, seconds=150))
        write(what, batch, ours, found)


# How many runs of each kind the experiment `paper` has in a dataset, and its datasets.
PAPER_DATASETS = 2 * 6
PAPER_EPOCHS = {("base", "single_to_multi"): 200, ("base", "multi_to_multi"): 100}
RECOMMENDED_EPOCHS = 40


def paper() -> None:
    """How long the experiment `paper` takes on collected data, from a few epochs of its runs on one dataset."""
    with attempt("paper"):
        data = dataset()
        found = {}
        for precision in PRECISIONS:
            with attempt(f"paper, {precision}"):
                found[precision] = measure_paper(data, precision)
        write("experiment paper without collecting, extrapolated", None, found, [])


def measure_paper(data: tuple[str, ...], precision: str) -> float:
    """Returns the seconds of the whole experiment."""
    folder, done = results("paper"), 4
    begin = time.perf_counter()
    harness(folder, "run", "paper", *data, "simulation.seed=0", f"training.device={DEVICE}",
            f"training.precision={precision}", f"training.last_epoch={done}", seconds=140)  # fmt: skip
    whole = time.perf_counter() - begin
    sql = (
        "select run, variant, task, epoch, max(seconds) as seconds from epochs group by run, variant, task, epoch "
        "order by epoch"
    )
    times: dict[tuple, list[float]] = {}
    for row in query(folder, sql):
        times.setdefault((row["run"], row["variant"], row["task"]), []).append(row["seconds"])
    trained = sum(sum(seconds) for seconds in times.values())
    estimate = whole - trained
    kinds: dict[tuple, list[float]] = {}
    for (_, variant, task), seconds in times.items():
        settings = dict(setting.split("=") for setting in variant.split(","))
        kind = settings["reading"], settings["role"]
        each = statistics.median(seconds[1:])
        kinds.setdefault((*kind, task), []).append(each)
        estimate += each * PAPER_EPOCHS.get(kind, RECOMMENDED_EPOCHS)
    for kind, seconds in sorted(kinds.items()):
        print(f"epoch of {', '.join(kind)}: {', '.join(f'{one * 1e3:.1f}' for one in seconds)} ms")
    print(f"14 runs on one dataset took {whole:.1f} s with {done} epochs each, of which {trained:.1f} s were epochs")
    minutes = estimate * PAPER_DATASETS / 60
    print(f"with all epochs and without early stopping: {estimate:.0f} s a dataset, {minutes:.1f} min in all")
    return estimate * PAPER_DATASETS


if __name__ == "__main__":
    tests, measurements = (ops, smoke, interrupt, two, memory), (render, steps, autotune, epochs, paper)
    named = {one.__name__: one for one in (machine, prepare, *tests, *measurements)}
    if len(sys.argv) != 2 or sys.argv[1] not in named:
        raise SystemExit(f"name a step: {', '.join(named)}")
    named[sys.argv[1]]()
    raise SystemExit(1 if failures else 0)
