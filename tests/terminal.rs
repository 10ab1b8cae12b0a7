//! What the commands print on terminals of 60, 80 and 120 columns.

use crate::common::{harness, write_script};
use std::fs::File;
use std::io::Read;
use std::os::fd::{FromRawFd, OwnedFd};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::LazyLock;
use tempfile::TempDir;

const WIDTHS: [u16; 3] = [60, 80, 120];

/// A folder with a short name that holds the experiments, and the results of a smoke run in `results`.
static FOLDER: LazyLock<TempDir> = LazyLock::new(|| {
    let folder = tempfile::tempdir().unwrap();
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("experiments");
    std::fs::create_dir(folder.path().join("experiments")).unwrap();
    for file in ["smoke.yaml", "claims.yaml", "readings.yaml", "single_to_multi.yaml", "multi_to_multi.yaml"]
    {
        std::fs::copy(source.join(file), folder.path().join("experiments").join(file)).unwrap();
    }
    let run = on_terminal(folder.path(), 80, &["run", "experiments/smoke.yaml"]);
    assert!(run.contains("2 done, 0 done before, 0 failed"), "{run}");
    folder
});

/// The output of a command on a terminal that is `width` characters wide, without control sequences.
fn on_terminal(folder: &Path, width: u16, arguments: &[&str]) -> String {
    plain(&raw(Command::new(env!("CARGO_BIN_EXE_harness")).current_dir(folder).args(arguments), width))
}

/// Everything that a command writes to a terminal.
pub fn raw(command: &mut Command, width: u16) -> String {
    let size = libc::winsize { ws_row: 50, ws_col: width, ws_xpixel: 0, ws_ypixel: 0 };
    let (mut ours, mut its) = (0, 0);
    // SAFETY: both numbers are written before they are read, and null stands for a name and settings that are not used.
    let opened = unsafe { libc::openpty(&mut ours, &mut its, std::ptr::null_mut(), std::ptr::null(), &size) };
    assert_eq!(opened, 0, "{}", std::io::Error::last_os_error());
    // SAFETY: `openpty` has just opened both.
    let (mut ours, its) = unsafe { (File::from_raw_fd(ours), OwnedFd::from_raw_fd(its)) };
    let stream = || Stdio::from(its.try_clone().unwrap());
    command.stdin(stream()).stdout(stream()).stderr(stream());
    command.env("TERM", "xterm-256color").env("LC_ALL", "C.UTF-8").env_remove("COLUMNS");
    let mut child = command.spawn().unwrap();
    // The terminal ends when nobody holds its other end any more, and then reading fails.
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    drop(its);
    let mut said = Vec::new();
    let mut part = [0; 4096];
    while let Ok(count @ 1..) = ours.read(&mut part) {
        said.extend(&part[..count]);
    }
    child.wait().unwrap();
    String::from_utf8(said).unwrap()
}

/// A text without the sequences that move the cursor or set colors.
pub fn plain(text: &str) -> String {
    let mut parts = text.split("\x1b[");
    let mut plain = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        plain += part.split_once(|end: char| end.is_ascii_alphabetic()).map_or("", |(_, rest)| rest);
    }
    plain.replace("\r\n", "\n")
}

/// The lines of a text that are wider than a terminal. A long word after a heading, such as a path, can't be broken, and
/// clap prints the usage of a command on one line. A carriage return begins a line anew.
pub fn too_wide(text: &str, width: u16) -> Vec<&str> {
    let is_breakable = |line: &&str| {
        let words = line.split_whitespace();
        words.clone().count() > 2 || words.map(|word| word.chars().count()).max() < Some(30)
    };
    let wide = text.split(['\n', '\r']).filter(|line| line.chars().count() > usize::from(width));
    wide.filter(is_breakable).filter(|line| !line.starts_with("Usage: ")).collect()
}

/// The names of all commands, as `harness --help` lists them.
fn commands() -> Vec<String> {
    let help = crate::common::succeed(Path::new("results"), &["--help"]);
    let listed =
        help.lines().skip_while(|line| *line != "Commands:").skip(1).take_while(|line| !line.is_empty());
    let named = listed.filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    named.map(|line| line.split_whitespace().next().unwrap().to_owned()).collect()
}

#[test]
fn no_line_is_wider_than_the_terminal() {
    let smoke = "experiments/smoke.yaml";
    let mut asked: Vec<Vec<&str>> = [
        &["run", smoke][..],
        &["run", smoke, "--dry-run", "training.epochs=3"],
        &["validate", smoke],
        &["ls"],
        &["show", "cluttered"],
        &["show", "cluttered", "--all"],
        &["diff", "empty", "cluttered"],
        &["compare"],
        &["compare", "--by", "scenario", "--metrics", "r2,rmse,relative_error_finger"],
        &["claims"],
        &["query", "select * from runs"],
        &["query", "select * from metrics"],
        &["query", "select experiment, run, status, seed from runs"],
        &["schema", "--tables"],
        &["world", "list"],
        &["world", "check", "cluttered"],
        &["du"],
        &["gc", "--only", "failed"],
        &["doctor"],
        &["verify"],
        &["--help"],
    ]
    .map(<[&str]>::to_vec)
    .to_vec();
    let commands = commands();
    assert!(commands.len() > 20 && commands.contains(&"compare".to_owned()), "{commands:?}");
    asked.extend(commands.iter().map(|command| vec![command.as_str(), "--help"]));
    for width in WIDTHS {
        for arguments in &asked {
            let said = on_terminal(FOLDER.path(), width, arguments);
            assert!(said.lines().count() > 0, "{arguments:?}");
            let wide = too_wide(&said, width);
            assert!(wide.is_empty(), "{arguments:?} at {width}: {wide:#?}");
        }
    }
}

#[test]
fn progress_shows_the_loss_before_the_rate_at_every_width() {
    for width in WIDTHS {
        let results = tempfile::tempdir().unwrap();
        let results = results.path().to_str().unwrap();
        let fast =
            ["tasks=[prediction]", "scenarios=[empty]", "training.epochs=40", "training.patience=null"];
        let said = on_terminal(
            FOLDER.path(),
            width,
            &[&["--results", results, "run", "experiments/smoke.yaml"][..], &fast].concat(),
        );
        let wide: Vec<_> =
            too_wide(&said, width).into_iter().filter(|line| !line.contains(results)).collect();
        assert!(wide.is_empty(), "at {width}: {wide:#?}");
        let drawn: Vec<&str> = said.split(['\n', '\r']).filter(|line| line.contains("/40 epochs")).collect();
        assert!(!drawn.is_empty(), "at {width}: {said}");
        for line in drawn {
            let place = |part: &str| line.find(part).unwrap_or(usize::MAX);
            assert!(place("validation ") < place("/40 epochs"), "at {width}: {line}");
            assert!(place("/40 epochs") < place("/s").min(place(" left")), "at {width}: {line}");
            assert!(width < 80 || line.contains(" left"), "at {width}: {line}");
        }
    }
}

#[test]
fn a_table_that_does_not_fit_has_a_block_for_each_row() {
    let query = ["query", "select * from runs"];
    let narrow = on_terminal(FOLDER.path(), 60, &query);
    let line = |name: &str, value: &str| {
        narrow.lines().any(|line| line.split_whitespace().collect::<Vec<_>>() == [name, value])
    };
    assert!(line("scenario", "cluttered") && line("scenario", "empty") && line("latent", "4"), "{narrow}");
    // A table that fits is a table, and a pipe gets one of any width.
    let few = on_terminal(FOLDER.path(), 60, &["query", "select scenario, seed from runs order by run"]);
    assert_eq!(few, "scenario   seed\n───────────────\ncluttered     0\nempty         0\n");
    let results = FOLDER.path().join("results");
    let piped = crate::common::succeed(&results, &query);
    assert_eq!(piped.lines().count(), 4, "a header, a rule and two rows: {piped}");
}

#[test]
fn a_terminal_that_shows_no_unicode_gets_ascii() {
    let script = FOLDER.path().join("ascii");
    write_script(&script, &format!("LC_ALL=C exec {} compare", env!("CARGO_BIN_EXE_harness")));
    for width in [60, 120] {
        let said = plain(&raw(Command::new(&script).current_dir(FOLDER.path()), width));
        assert!(said.is_ascii() && said.contains("R2 ^") && too_wide(&said, width).is_empty(), "{said}");
    }
    let piped = harness(&FOLDER.path().join("results"), &["compare"]).env("LC_ALL", "C").output().unwrap();
    assert!(String::from_utf8(piped.stdout).unwrap().contains("R2 ↑"));
}

#[test]
fn a_run_ends_with_the_best_run_the_baselines_the_place_and_what_to_do_next() {
    let said = on_terminal(FOLDER.path(), 120, &["run", "experiments/smoke.yaml"]);
    let lines: Vec<&str> = said.lines().collect();
    let [counts, best, baselines, results, next] = lines[lines.len() - 5..] else { panic!("{said}") };
    assert_eq!(counts, "0 done, 2 done before, 0 failed");
    assert!(best.starts_with("best run   ") && best.contains("-z4-seed0-"), "{said}");
    // The smoke run predicts five quantities of three outputs; ridge predicts no images.
    assert!(baselines.contains("persistence in ") && baselines.contains("training mean in "), "{said}");
    assert!(baselines.starts_with("baselines  beats "), "{said}");
    assert!(baselines.ends_with(" of 3 outputs") && baselines.contains(" of 2,"), "{said}");
    assert!(results.starts_with("results    /") && results.ends_with("/results/runs/smoke"), "{said}");
    assert_eq!(next, "next       harness compare smoke");
}

#[test]
fn the_best_run_and_what_it_beats_are_those_of_the_tables() {
    let results = FOLDER.path().join("results");
    let folder = tempfile::tempdir().unwrap();
    let ask = |sql: &str| -> Vec<serde_json::Value> {
        let path = folder.path().join("answer.json");
        crate::common::succeed(&results, &["query", sql, "--output", path.to_str().unwrap()]);
        serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
    };
    // For each run, the epoch with the lowest weighted sum, and there the plain mean of the outputs' errors.
    let epochs =
        ask("select run, epoch, term, value from epochs where task = 'prediction' and split = 'validation'");
    let value = |row: &serde_json::Value| row["value"].as_f64().unwrap();
    let runs: std::collections::BTreeSet<&str> =
        epochs.iter().map(|row| row["run"].as_str().unwrap()).collect();
    let error = |run: &str| {
        let own: Vec<_> = epochs.iter().filter(|row| row["run"] == run).collect();
        let totals = own.iter().filter(|row| row["term"] == "total");
        let kept = &totals.min_by(|a, b| value(a).total_cmp(&value(b))).unwrap()["epoch"];
        let outputs: Vec<f64> = own
            .iter()
            .filter(|row| row["epoch"] == *kept && row["term"] != "total" && row["term"] != "kl")
            .map(|row| value(row))
            .collect();
        outputs.iter().sum::<f64>() / outputs.len() as f64
    };
    let best = runs.iter().min_by(|a, b| error(a).total_cmp(&error(b))).unwrap();
    let metrics = ask(&format!(
        "select model, modality, metric, value from metrics where run = '{best}' and task = 'prediction' and index is null \
         and direction is null and metric in ('r2', 'relative_error')"
    ));
    let of = |model: &str, modality: &str| {
        metrics
            .iter()
            .find(|row| row["model"] == model && row["modality"] == modality && !row["value"].is_null())
    };
    let said = crate::common::succeed(&results, &["run", crate::common::SMOKE]);
    assert!(said.contains(&format!("\nbest run   {best} (")), "{best}: {said}");
    for baseline in ["persistence", "ridge", "training_mean"] {
        let (mut better, mut outputs) = (0, 0);
        for modality in ["proprioception", "contact_force", "frame_difference"] {
            let (Some(network), Some(baseline)) = (of("network", modality), of(baseline, modality)) else {
                continue;
            };
            outputs += 1;
            let higher = value(network) > value(baseline);
            better += i32::from(if network["metric"] == "r2" { higher } else { !higher });
        }
        let expected = format!("{} in {better} of {outputs}", baseline.replace('_', " "));
        assert!(said.contains(&expected), "{expected}: {said}");
    }
}

#[test]
fn a_run_is_shown_in_short_unless_all_of_it_is_asked_for() {
    let results = FOLDER.path().join("results");
    let short = crate::common::succeed(&results, &["show", "cluttered"]);
    assert!(short.lines().count() < 45, "{} lines: {short}", short.lines().count());
    for part in [": done", "input", "proprioception+vision", "R2 ↑", "persistence", "command", " --all"] {
        assert!(short.contains(part), "no {part} in {short}");
    }
    assert!(!short.contains("learning_rate") && !short.contains("encoder.conv"), "{short}");
    let all = crate::common::succeed(&results, &["show", "cluttered", "--all"]);
    for part in ["learning_rate: ", "encoder.conv", "mujoco_version", "relative_error_finger"] {
        assert!(all.contains(part), "no {part} in {all}");
    }
}
