//! Work that several processes divide, and its submission to Slurm, for which scripts stand in here. `make cluster`
//! uses a real one.

use crate::common::{Answer, Disk, FAILING, SMOKE, finish, fresh, harness, succeed, write_script};
use crate::interruption::{signal, start_command};
use harness_experiment::turns::{Turn, Turns};
use std::collections::BTreeMap;
use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Child, Command, Stdio};

const FOUR_RUNS: [&str; 3] = ["seeds=[0,1]", "tasks=[prediction]", "training.epochs=1"];

/// The metrics of all runs, as CSV.
fn metrics(results: &Path) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("metrics.csv");
    let sql = "select * from metrics order by run, task, model, modality, metric, index, direction";
    succeed(results, &["query", sql, "--output", path.to_str().unwrap()]);
    fs::read_to_string(path).unwrap()
}

/// How many runs a process did.
fn done(said: &str) -> usize {
    let line = said.lines().find(|line| line.contains(" done before, ")).unwrap();
    line.split(' ').next().unwrap().parse().unwrap()
}

#[test]
fn shards_do_each_run_once_and_give_the_same_tables() {
    let (whole, shared) = (fresh("shards-whole"), fresh("shards-shared"));
    succeed(&whole, &[&["run", SMOKE][..], &FOUR_RUNS].concat());
    let said: Vec<String> = std::thread::scope(|scope| {
        let share = |number: usize| {
            let (shard, shared) = (format!("{number}/3"), &shared);
            scope.spawn(move || {
                succeed(shared, &[&["run", SMOKE, "--shard", &shard, "--no-wait"][..], &FOUR_RUNS].concat())
            })
        };
        let shares: Vec<_> = (1..=3).map(share).collect();
        shares.into_iter().map(|share| share.join().unwrap()).collect()
    });
    assert_eq!(said.iter().map(|said| done(said)).collect::<Vec<_>>(), [2, 1, 1]);
    assert_eq!(metrics(&shared), metrics(&whole));
    let again = succeed(&shared, &[&["run", SMOKE][..], &FOUR_RUNS].concat());
    assert!(again.contains("0 done, 4 done before, 0 failed"), "{again}");
}

/// Starts a shard that trains with one thread and has its turns in the results folder, and waits until it has to wait.
fn start_waiting(results: &Path) -> (Child, BufReader<std::process::ChildStderr>) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_harness"));
    command.arg("--results").arg(results).args(["--threads", "1", "run", SMOKE, "--shard", "1/2"]);
    command
        .arg("--no-wait")
        .args(FOUR_RUNS)
        .env("TMPDIR", results)
        .stdout(Stdio::null())
        .stderr(Stdio::piped());
    let mut child = start_command(&mut command);
    let mut said = BufReader::new(child.stderr.take().unwrap());
    let mut line = String::new();
    while !line.starts_with("waiting until another shard on this machine has finished a run") {
        line.clear();
        assert!(said.read_line(&mut line).unwrap() > 0, "the shard ended without waiting");
    }
    (child, said)
}

#[test]
fn shards_of_one_machine_take_turns_at_training() {
    let results = fresh("shards-turns");
    fs::create_dir_all(&results).unwrap();
    let turns = Turns::new(&results, 1).unwrap();
    let mut held: Vec<Turn> = (0..turns.count()).map(|_| turns.take(|| false).unwrap()).collect();
    assert!(turns.take(|| false).is_none(), "no turn is left");
    // A process that does not share the work does not wait.
    let alone = ["--threads", "1", "run", SMOKE, "seeds=[2]", "tasks=[prediction]", "training.epochs=1"];
    assert_eq!(finish(harness(&results, &alone).env("TMPDIR", &results)).code, 0);
    // A shard that waits has begun nothing, and stops when it is told to.
    let (mut child, mut said) = start_waiting(&results);
    signal(&child, libc::SIGTERM);
    let mut rest = String::new();
    said.read_to_string(&mut rest).unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(143), "{rest}");
    assert_eq!(fs::read_dir(results.join("runs/smoke")).unwrap().count(), 2);
    // It goes on when one turn is free. Those that come later do not pass it.
    let (mut child, _said) = start_waiting(&results);
    assert!(turns.take(|| false).is_none());
    held.pop();
    assert!(child.wait().unwrap().success());
    let again = succeed(&results, &[&["run", SMOKE, "--shard", "1/2"][..], &FOUR_RUNS].concat());
    assert!(again.contains("0 done, 2 done before, 0 failed"), "{again}");
}

/// The bytes of a dataset's episodes, by the file's name.
fn episodes(results: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = BTreeMap::new();
    for dataset in fs::read_dir(results.join("datasets")).unwrap() {
        for file in fs::read_dir(dataset.unwrap().path()).unwrap() {
            let path = file.unwrap().path();
            let name = path.strip_prefix(results).unwrap().display().to_string();
            if !name.contains(".unfinished") {
                found.insert(name, fs::read(path).unwrap());
            }
        }
    }
    found
}

#[test]
fn shards_collect_the_same_datasets_with_those_that_vary() {
    let (whole, shared) = (fresh("shards-collected"), fresh("shards-collected-shared"));
    let varied = "vary={simulation.seed: [0, 1]}";
    succeed(&whole, &["collect", SMOKE, varied]);
    assert_eq!(fs::read_dir(whole.join("datasets")).unwrap().count(), 4);
    // Each share has 16 / 3 episodes, whatever datasets they belong to.
    for (shard, made) in [("1/3", 6), ("2/3", 5), ("3/3", 5)] {
        let said = succeed(&shared, &["collect", SMOKE, varied, "--shard", shard]);
        let count = |line: &str| line.split(": ").last().unwrap().split(' ').next().unwrap().parse::<usize>();
        let counts: usize = said.lines().map(|line| count(line).unwrap()).sum();
        assert_eq!(counts, made, "{said}");
        // An episode has 30 samples.
        let ends = match shard {
            "1/3" => "2 episodes made, 60 of 120 samples so far",
            "3/3" => "1 episode made, 120 samples in all",
            _ => "made, 90 of 120 samples so far",
        };
        assert!(said.lines().next().unwrap().ends_with(ends), "{said}");
    }
    assert!(episodes(&shared) == episodes(&whole));
}

#[test]
fn what_is_no_shard_is_refused_in_one_line() {
    for shard in ["9/8", "0/8", "0/3", "3", "1/0", "1/1000000", "a/b", "1/8/8", ""] {
        for command in ["run", "collect"] {
            let answer = finish(&mut harness(Path::new("nowhere"), &[command, SMOKE, "--shard", shard]));
            assert_eq!(answer.code, 2, "{command} {shard}");
            let said = answer.stderr.lines().next().unwrap();
            assert!(said.contains("a shard is I/N, with I from 1 to N"), "{said}");
        }
    }
    assert!(!Path::new("nowhere").exists());
}

#[test]
fn failing_fast_leaves_the_other_runs() {
    let results = fresh("fail-fast");
    let answer = finish(&mut harness(&results, &[&["run", SMOKE, "--fail-fast"], &FAILING[..]].concat()));
    assert_eq!(answer.code, 1);
    assert!(answer.stdout.contains("0 done, 0 done before, 1 failed"), "{}", answer.stdout);
    assert!(answer.stdout.contains("1 not tried, because of --fail-fast"), "{}", answer.stdout);
}

/// A folder of programs with a Slurm that numbers jobs from 101 on, and notes what it is asked for in `calls`.
fn slurm() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let calls = folder.path().join("calls");
    let count = format!("echo \"$0 $*\" >>{0}; grep -c sbatch {0}", calls.display());
    write_script(&folder.path().join("sbatch"), &format!("n=$({count}); echo $((100 + n))"));
    write_script(&folder.path().join("scancel"), &count);
    write_script(
        &folder.path().join("squeue"),
        "echo '102|1|RUNNING|node7|1:23|None'; echo '102|2|PENDING|||Resources'",
    );
    folder
}

fn with_slurm(slurm: &Path, results: &Path, arguments: &[&str]) -> Answer {
    let path = format!("{}:{}", slurm.display(), std::env::var("PATH").unwrap());
    finish(harness(results, arguments).env("PATH", path))
}

#[test]
fn a_submission_is_three_jobs_that_wait_for_each_other() {
    let (results, slurm) = (fresh("submitted"), slurm());
    let answer = with_slurm(slurm.path(), &results, &["submit", SMOKE, "--tasks", "2", "seeds=[0,1]"]);
    assert_eq!(answer.code, 0, "{}", answer.stderr);
    assert!(
        answer.stdout.starts_with("4 runs of smoke submitted: collect 101, train 102, finish 103\n"),
        "{}",
        answer.stdout
    );
    assert!(answer.stdout.ends_with("scancel 101 102 103\n"), "{}", answer.stdout);
    let calls = fs::read_to_string(slurm.path().join("calls")).unwrap();
    let calls: Vec<&str> = calls.lines().collect();
    assert!(calls[0].ends_with("/collect.sh") && !calls[0].contains("--dependency"), "{calls:?}");
    assert!(calls[1].contains("--dependency=afterany:101") && calls[1].ends_with("/train.sh"), "{calls:?}");
    assert!(calls[2].contains("--dependency=afterany:102") && calls[2].ends_with("/finish.sh"), "{calls:?}");

    let folder = fs::read_dir(results.join("jobs")).unwrap().next().unwrap().unwrap().path();
    fs::write(folder.join("train-1.log"), "task 1 begins\nsmoke: 3/8 epochs\n").unwrap();
    fs::write(folder.join("collect-1.log"), "task 1 ends with code 0\n").unwrap();
    let listed = with_slurm(slurm.path(), &results, &["ls", "--jobs"]).stdout;
    for part in
        ["running", "node7", "1:23", "3/8 epochs", "pending", "Resources", "ended", "ends with code 0"]
    {
        assert!(listed.contains(part), "{part}: {listed}");
    }
}

/// Slurm's scripts, by the name of the step.
fn scripts(results: &Path, arguments: &[&str]) -> BTreeMap<String, String> {
    let said = succeed(results, &[&["submit", SMOKE, "--dry-run"][..], arguments].concat());
    let parts = said.split("==> ").skip(1).map(|part| {
        let (path, script) = part.split_once(" <==\n").unwrap();
        let step = Path::new(path).file_stem().unwrap().to_string_lossy().into_owned();
        (step, script.to_owned())
    });
    parts.collect()
}

#[test]
fn options_that_would_break_a_script_are_refused() {
    let results = fresh("refused_options");
    let refused = |more: &[&str]| {
        let answer = finish(&mut harness(&results, &[&["submit", SMOKE, "--dry-run"], more].concat()));
        assert_eq!(answer.code, 2, "{more:?}: {}", answer.stdout);
        answer.stderr
    };
    assert!(refused(&["--sbatch=--array=3"]).contains("--array is set by the harness; tasks, throttle"));
    assert!(refused(&["--sbatch=-o x.log"]).contains("-o is set by the harness"));
    assert!(
        refused(&["--sbatch=account"]).contains("'account' is no option of sbatch; one is --account=lab")
    );
    assert!(refused(&["--memory", ""]).contains("'memory' is empty or has a line break"));
    let config = results.with_extension("yaml");
    fs::write(&config, "partition: \"a\\nb\"\n").unwrap();
    let said = refused(&["--config", config.to_str().unwrap()]);
    assert!(
        said.contains("refused_options.yaml: a value of 'partition' is empty or has a line break"),
        "{said}"
    );
}

#[test]
fn scripts_say_what_was_asked_for_and_are_bash() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("cluster.yaml");
    fs::write(&config, "tasks: 6\ncpus: 2\npartition: gpu\nsetup: ['module load mesa']\n").unwrap();
    let config = config.to_str().unwrap();
    let flags = ["--config", config, "--partition", "cpu", "--time", "01:00:00", "--throttle", "3"];
    let more = ["--memory", "8G", "--sbatch=--account=lab", "seeds=[0,1,2]"];
    let results = fresh("scripts with spaces");
    let scripts = scripts(&results, &[&flags[..], &more].concat());
    assert_eq!(scripts.keys().collect::<Vec<_>>(), ["collect", "finish", "train"]);
    let train = &scripts["train"];
    for part in [
        "#SBATCH --job-name=harness-smoke-train\n",
        "#SBATCH --array=1-6%3\n",
        "#SBATCH --cpus-per-task=2\n",
        "#SBATCH --mem=8G\n",
        "#SBATCH --time=01:00:00\n",
        "#SBATCH --partition=cpu\n",
        "#SBATCH --account=lab\n",
        "\nmodule load mesa\n",
        "tasks=6\n",
        "run experiments/smoke.yaml 'seeds=[0,1,2]' --shard \"$SLURM_ARRAY_TASK_ID/$tasks\" --no-wait &\n",
    ] {
        assert!(train.contains(part), "{part}: {train}");
    }
    assert!(scripts["collect"].contains("#SBATCH --array=1-6%3\n"), "{}", scripts["collect"]);
    assert!(!scripts["finish"].contains("--array"), "{}", scripts["finish"]);
    for script in scripts.values() {
        let path = folder.path().join("script.sh");
        fs::write(&path, script).unwrap();
        assert!(Command::new("bash").arg("-n").arg(&path).status().unwrap().success());
    }
    assert!(!results.join("jobs").exists());
}

/// A script's task, as Slurm starts it.
#[test]
fn a_script_does_its_task_and_says_how_it_ended() {
    let results = fresh("scripted");
    let train = &scripts(&results, &["scenarios=[empty]", "training.epochs=1", "--tasks", "1"])["train"];
    let folder = tempfile::tempdir().unwrap();
    write_script(&folder.path().join("scontrol"), "echo 'JobId=7 JobState=RUNNING'");
    let path = folder.path().join("train.sh");
    fs::write(&path, train).unwrap();
    let programs = format!("{}:{}", folder.path().display(), std::env::var("PATH").unwrap());
    let output = Command::new("bash")
        .arg(&path)
        .env("PATH", programs)
        .envs([("SLURM_ARRAY_TASK_ID", "1"), ("SLURM_JOB_ID", "7")])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    assert!(said.contains("task 1 begins on ") && said.contains("1 done, 0 done before, 0 failed"), "{said}");
    assert!(said.trim_end().ends_with("task 1 ends with code 0"), "{said}");
}

#[test]
fn a_refused_submission_is_one_line_and_leaves_nothing() {
    let results = fresh("unsubmitted");
    let missing = finish(harness(&results, &["submit", SMOKE]).env("PATH", "/nowhere"));
    assert_eq!(missing.code, 2);
    assert!(missing.stderr.contains("sbatch is not installed"), "{}", missing.stderr);
    let refusing = tempfile::tempdir().unwrap();
    write_script(
        &refusing.path().join("sbatch"),
        "echo 'sbatch: error: invalid partition specified: moon' >&2; exit 1",
    );
    let refused = with_slurm(refusing.path(), &results, &["submit", SMOKE, "--partition", "moon"]);
    assert_eq!(refused.code, 1);
    assert_eq!(
        refused.stderr.lines().last().unwrap(),
        "error: sbatch failed: sbatch: error: invalid partition specified: moon"
    );
    assert!(fs::read_dir(results.join("jobs")).unwrap().next().is_none());
    let config = refusing.path().join("cluster.yaml");
    for (setting, said) in
        [("tasks: 0", "'tasks' is 0, and must be from 1 to 1000"), ("cpus: 2000", "'cpus' is 2000,")]
    {
        fs::write(&config, setting).unwrap();
        let answer = finish(&mut harness(&results, &["submit", SMOKE, "--config", config.to_str().unwrap()]));
        assert!(answer.code == 2 && answer.stderr.contains(said), "{}", answer.stderr);
    }
    fs::write(&config, "tasks: 8\npartitions: gpu\n").unwrap();
    let unknown = finish(&mut harness(&results, &["submit", SMOKE, "--config", config.to_str().unwrap()]));
    assert_eq!(unknown.code, 2);
    assert!(unknown.stderr.contains("cluster.yaml:2:1: "), "{}", unknown.stderr);
    assert!(unknown.stderr.contains("partitions"), "{}", unknown.stderr);
}

/// The last line of a refusal, which is its only error. Only this line remains to be read after a long plan.
#[track_caller]
fn refusal(answer: &Answer, code: i32) -> String {
    assert_eq!((answer.code, answer.stdout.as_str()), (code, ""), "{}", answer.stderr);
    answer.stderr.lines().last().unwrap().strip_prefix("error: ").unwrap().to_owned()
}

#[test]
fn a_submission_of_which_one_job_is_refused_is_cancelled() {
    let (results, slurm) = (fresh("submitted-in-part"), slurm());
    let calls = slurm.path().join("calls");
    // The second job is refused, in two lines as by the real sbatch.
    let script = format!(
        "echo \"sbatch $*\" >>{0}; [ $(grep -c sbatch {0}) = 1 ] && echo 101 && exit; \
         echo 'sbatch: error: invalid partition specified: moon' >&2; \
         echo 'sbatch: error: Batch job submission failed: Invalid partition name specified' >&2; exit 1",
        calls.display()
    );
    write_script(&slurm.path().join("sbatch"), &script);
    let answer = with_slurm(slurm.path(), &results, &["submit", SMOKE, "--partition", "moon"]);
    assert_eq!(
        refusal(&answer, 1).replace("error: ", ""),
        "sbatch failed: sbatch: invalid partition specified: moon; sbatch: Batch job submission failed: Invalid \
         partition name specified"
    );
    let calls = fs::read_to_string(calls).unwrap();
    assert!(calls.lines().last().unwrap().ends_with("scancel 101"), "{calls}");
    assert!(fs::read_dir(results.join("jobs")).unwrap().next().is_none());
}

#[test]
fn a_full_disk_submits_nothing() {
    // Room for one of the three scripts.
    let Some(disk) = Disk::new(4) else {
        println!("skipped: no small disk can be mounted here");
        return;
    };
    let slurm = slurm();
    let said = refusal(&with_slurm(slurm.path(), disk.path(), &["submit", SMOKE]), 1);
    assert!(
        said.starts_with("can't write ") && said.ends_with("train.sh: No space left on device (os error 28)"),
        "{said}"
    );
    assert!(!slurm.path().join("calls").exists(), "nothing was asked of Slurm");
    assert!(fs::read_dir(disk.path().join("jobs")).unwrap().next().is_none());
}

#[test]
fn jobs_that_cannot_be_listed_are_kept() {
    let (results, slurm) = (fresh("unlisted"), slurm());
    with_slurm(slurm.path(), &results, &["submit", SMOKE]);
    let folder = fs::read_dir(results.join("jobs")).unwrap().next().unwrap().unwrap().path();
    let said = refusal(&finish(harness(&results, &["ls", "--jobs"]).env("PATH", "/nowhere")), 2);
    assert!(
        said.starts_with("squeue is not installed, so this machine is not part of a Slurm cluster"),
        "{said}"
    );
    assert!(folder.join("job.json").is_file() && folder.join("train.sh").is_file());
    let config = slurm.path().join("cluster.yaml");
    fs::write(&config, "tasks: many\n").unwrap();
    let words = ["submit", SMOKE, "--config", config.to_str().unwrap()];
    let said = refusal(&with_slurm(slurm.path(), &results, &words), 2);
    assert!(said.contains("cluster.yaml:1:8: "), "{said}");
    let missing = ["submit", SMOKE, "--config", "/nowhere.yaml"];
    assert!(refusal(&with_slurm(slurm.path(), &results, &missing), 2).starts_with("/nowhere.yaml: "));
    assert_eq!(fs::read_dir(results.join("jobs")).unwrap().count(), 1);
}
