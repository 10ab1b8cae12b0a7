//! What the commands print on terminals of 60, 80 and 120 columns.

use crate::common::{harness, write_script};
use harness::seal;
use serde_json::Value;
use std::fs::File;
use std::io::{Read, Write};
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
    for file in
        ["smoke.yaml", "claims.yaml", "reproduction.yaml", "single_to_multi.yaml", "multi_to_multi.yaml"]
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
    raw_while(command, width, |_| ())
}

/// Everything that a command writes to a terminal. `heard` is called with what was written so far.
pub fn raw_while(command: &mut Command, width: u16, heard: impl Fn(&str)) -> String {
    raw_typed(command, width, |said| {
        heard(said);
        None
    })
}

/// Everything that a command writes to a terminal, on which what `typed` returns is typed. `typed` is called with what
/// was written so far.
pub fn raw_typed(command: &mut Command, width: u16, typed: impl Fn(&str) -> Option<&'static str>) -> String {
    let size = libc::winsize { ws_row: 50, ws_col: width, ws_xpixel: 0, ws_ypixel: 0 };
    let (mut ours, mut its) = (0, 0);
    // SAFETY: both numbers are written before they are read, and null stands for a name and settings that are not used.
    let opened = unsafe { libc::openpty(&mut ours, &mut its, std::ptr::null_mut(), std::ptr::null(), &size) };
    assert_eq!(opened, 0, "{}", std::io::Error::last_os_error());
    // Programs that other tests start would keep the terminal open.
    // SAFETY: `openpty` has just opened both.
    let (mut ours, its) = unsafe {
        for end in [ours, its] {
            libc::fcntl(end, libc::F_SETFD, libc::FD_CLOEXEC);
        }
        (File::from_raw_fd(ours), OwnedFd::from_raw_fd(its))
    };
    let stream = || Stdio::from(its.try_clone().unwrap());
    command.stdin(stream()).stdout(stream()).stderr(stream());
    command.env("TERM", "xterm-256color").env("LC_ALL", "C.UTF-8").env_remove("COLUMNS");
    // Mesa complains where it can't write to the user's folder.
    command.env("XDG_CACHE_HOME", env!("CARGO_TARGET_TMPDIR"));
    let mut child = command.spawn().unwrap();
    // The terminal ends when nobody holds its other end any more, and then reading fails.
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    drop(its);
    let mut said = Vec::new();
    let mut part = [0; 4096];
    while let Ok(count @ 1..) = ours.read(&mut part) {
        said.extend(&part[..count]);
        if let Some(typed) = typed(&String::from_utf8_lossy(&said)) {
            ours.write_all(typed.as_bytes()).unwrap();
        }
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

/// The lines of a text that are wider than a terminal. A long word after a heading, such as a path, can't be broken,
/// and clap prints the usage of a command on one line. A carriage return begins a line anew.
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
        &["diff", "empty", "cluttered", "--all"],
        &["compare"],
        &["compare", "--by", "scenario", "--metrics", "r2,rmse,relative_error_finger"],
        &["claims"],
        &["claims", "--all"],
        &["query", "select * from runs"],
        &["query", "select * from metrics"],
        &["query", "select experiment, run, status, seed from runs"],
        &["schema", "--tables"],
        &["world", "list"],
        &["world", "check", "cluttered"],
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
            ["tasks=[prediction]", "scenarios=[empty]", "training.epochs=90", "training.patience=null"];
        let said = on_terminal(
            FOLDER.path(),
            width,
            &[&["--results", results, "run", "experiments/smoke.yaml"][..], &fast].concat(),
        );
        let wide: Vec<_> =
            too_wide(&said, width).into_iter().filter(|line| !line.contains(results)).collect();
        assert!(wide.is_empty(), "at {width}: {wide:#?}");
        let lines = said.split(['\n', '\r']);
        // There is no loss before the first epoch.
        let drawn: Vec<&str> =
            lines.filter(|line| line.contains("/90 epochs") && !line.contains(" 0/90 epochs")).collect();
        assert!(!drawn.is_empty(), "at {width}: {said}");
        for line in drawn {
            let place = |part: &str| line.find(part).unwrap_or(usize::MAX);
            assert!(place("validation ") < place("/90 epochs"), "at {width}: {line}");
            assert!(place("/90 epochs") < place("/s").min(place(" left")), "at {width}: {line}");
            assert!(width < 120 || line.contains(" left"), "at {width}: {line}");
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
fn a_run_ends_with_its_best_runs_baselines_place_and_next_steps() {
    let said = on_terminal(FOLDER.path(), 120, &["run", "experiments/smoke.yaml"]);
    let lines: Vec<&str> = said.lines().collect();
    let [counts, best @ .., results, next] = &lines[lines.len() - 7..] else { panic!("{said}") };
    assert_eq!(*counts, "0 done, 2 done before, 0 failed");
    for (lines, scenario) in best.chunks(2).zip(["empty", "cluttered"]) {
        let [best, baselines] = lines else { panic!("{said}") };
        assert!(best.starts_with(&format!("best run   in {scenario}: {scenario}-z4-seed0-")), "{said}");
        assert!(best.contains(" (validation error ") && best.len() <= 80, "{said}");
        // The smoke run predicts five quantities of three outputs; ridge predicts no images.
        assert!(baselines.contains("persistence in ") && baselines.contains("training mean in "), "{said}");
        assert!(baselines.starts_with("baselines  beats "), "{said}");
        assert!(
            baselines.ends_with(" of 3 outputs by R2 or relative error") && baselines.contains(" of 2,"),
            "{said}"
        );
    }
    assert!(results.starts_with("results    /") && results.ends_with("/results/runs/smoke"), "{said}");
    assert_eq!(*next, "next       harness compare smoke");
}

#[test]
fn the_best_runs_and_what_they_beat_are_those_of_the_tables() {
    let folder = tempfile::tempdir().unwrap();
    let results = folder.path().join("results");
    let said = crate::common::succeed(&results, &["run", crate::common::SMOKE, "seeds=[0,1]"]);
    let ask = |sql: &str| crate::common::ask(&results, sql);
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
    assert_eq!(runs.len(), 4);
    for scenario in ["empty", "cluttered"] {
        let own = runs.iter().filter(|run| run.starts_with(scenario));
        let best = own.min_by(|a, b| error(a).total_cmp(&error(b))).unwrap();
        let start = format!("\nbest run   in {scenario}: {best} (validation error ");
        let (_, told) = said.split_once(&start).unwrap_or_else(|| panic!("no {start}: {said}"));
        let metrics = ask(&format!(
            "select model, modality, metric, value from metrics where run = '{best}' and task = 'prediction' \
             and index is null and direction is null and metric in ('r2', 'relative_error')"
        ));
        let of = |model: &str, modality: &str| {
            metrics
                .iter()
                .find(|row| row["model"] == model && row["modality"] == modality && !row["value"].is_null())
        };
        for baseline in ["persistence", "ridge", "training_mean"] {
            let (mut better, mut outputs) = (0, 0);
            for modality in ["proprioception", "contact_force", "frame_difference"] {
                let (Some(network), Some(baseline)) = (of("network", modality), of(baseline, modality))
                else {
                    continue;
                };
                outputs += 1;
                let higher = value(network) > value(baseline);
                better += i32::from(if network["metric"] == "r2" { higher } else { !higher });
            }
            let expected = format!("{} in {better} of {outputs}", baseline.replace('_', " "));
            assert!(told.lines().nth(1).unwrap().contains(&expected), "{expected}: {said}");
        }
    }
    // With one scenario there is nothing to tell apart, and runs that were validated on other samples are not compared.
    let arguments = ["run", crate::common::SMOKE, "scenarios=empty", "seeds=[0,1]"];
    let one = crate::common::succeed(&results, &arguments);
    assert!(one.contains("\nbest run   empty-z4-seed"), "{one}");
    let varied = "vary={split.validation: [0.25, 0.5]}";
    let other = crate::common::succeed(&results, &[&arguments[..], &[varied]].concat());
    assert!(other.contains("4 done, 0 done before") && !other.contains("best run"), "{other}");
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
    for part in [
        "learning_rate: ",
        "encoder.conv",
        "mujoco_version",
        "relative error finger ↓",
        "fe  ",
        "RMSE (rad) ↓",
    ] {
        assert!(all.contains(part), "no {part} in {all}");
    }
}

#[test]
fn all_metrics_of_a_run_are_tables_with_a_line_for_each() {
    let narrow = on_terminal(FOLDER.path(), 80, &["show", "cluttered", "--all"]);
    assert!(narrow.lines().count() < 300, "{} lines: {narrow}", narrow.lines().count());
    let all = on_terminal(FOLDER.path(), 120, &["show", "cluttered", "--all"]);
    let row = |line: &&str| line.starts_with("frame difference") && line.contains("relative error arm ↓");
    assert_eq!(all.lines().filter(row).count(), 1, "{all}");
    // A column without a value is named too.
    assert!(all.lines().any(|line| line.split_whitespace().eq(["reading", "-"])), "{all}");
}

#[test]
fn the_title_of_a_table_does_not_widen_its_columns() {
    let said = on_terminal(FOLDER.path(), 80, &["run", "experiments/smoke.yaml"]);
    let title = said.lines().position(|line| line == "prediction, cluttered").unwrap();
    let table: Vec<&str> = said.lines().skip(title + 1).take_while(|line| !line.is_empty()).collect();
    // A header, a rule, and a line for each of two metrics of the angles, two of the forces and one of the image.
    assert_eq!(table.len(), 2 + 5, "{said}");
    assert!(table.iter().any(|line| line.starts_with("frame difference  relative error ↓ ")), "{said}");
}

#[test]
fn the_networks_of_a_run_have_a_table_each_that_breaks_no_cell() {
    let folder = tempfile::tempdir().unwrap();
    let results = folder.path().to_str().unwrap();
    let arguments =
        ["--results", results, "run", "experiments/smoke.yaml", "scenarios=[cluttered]", "latent=[4,128]"];
    let said = on_terminal(FOLDER.path(), 80, &arguments);
    for title in ["prediction, latent 4", "prediction, latent 128"] {
        let title = said.lines().position(|line| line == title).unwrap_or_else(|| panic!("{title}: {said}"));
        let table: Vec<&str> = said.lines().skip(title + 1).take_while(|line| !line.is_empty()).collect();
        assert_eq!(table.len(), 2 + 5, "{said}");
    }
}

#[test]
fn numbers_of_a_block_are_aligned_and_missing_ones_left_out() {
    let said = on_terminal(FOLDER.path(), 60, &["run", "experiments/smoke.yaml"]);
    let block = said.split("prediction, cluttered, contact force, R2 ↑\n").nth(1).unwrap();
    let block: Vec<&str> = block.split("\n\n").next().unwrap().lines().collect();
    assert_eq!(block.len(), 4, "{said}");
    let points: std::collections::BTreeSet<_> = block.iter().map(|line| line.find('.')).collect();
    assert_eq!(points.len(), 1, "{said}");
    assert!(!said.lines().any(|line| line.ends_with(" -")), "{said}");
}

#[test]
fn an_empty_value_keeps_its_name_in_a_block() {
    let said = on_terminal(FOLDER.path(), 60, &["query", "select * from runs"]);
    assert_eq!(said.lines().filter(|line| *line == "variant").count(), 2, "{said}");
    assert_eq!(said.lines().filter(|line| line.is_empty()).count(), 1, "between the two runs: {said}");
}

#[test]
fn messages_are_broken_between_words_and_commands_are_not() {
    for (arguments, command) in [
        (&["show", "nothing"][..], Some("`harness ls`")),
        (&["run", "nothing"], None),
        (&["query", "select foo from runs"], None),
        (&["plot", "smoke", "--x", "seed", "--metrics", "r2"], Some("possible values: experiment")),
        (&["ls", "nothing"], Some("`harness ls`")),
    ] {
        let said = on_terminal(FOLDER.path(), 60, arguments);
        assert!(said.starts_with("error: ") && too_wide(&said, 60).is_empty(), "{said}");
        assert!(command.is_none_or(|command| said.contains(command)), "{said}");
    }
}

#[test]
fn runs_are_listed_in_one_line_each() {
    for width in WIDTHS {
        let said = on_terminal(FOLDER.path(), width, &["ls"]);
        let rows: Vec<&str> = said.lines().filter(|line| line.contains("-z4-seed0-")).collect();
        assert!(rows.len() == 2 && rows.iter().all(|row| row.ends_with(" s")), "at {width}: {said}");
        assert_eq!(said.contains("experiment  "), width > 60, "at {width}: {said}");
        assert_eq!(on_terminal(FOLDER.path(), width, &["ls", "--status", "failed"]), "no runs\n");
    }
}

#[test]
fn a_verdict_is_on_the_line_of_its_scenario_and_value() {
    let file = FOLDER.path().join("own_claims.yaml");
    let claim = |id: &str| {
        format!(
            "- id: {id}\n  statement: Links feel forces.\n  measured: mean force, N\n  scenarios: [empty, cluttered]\n  \
             experiments: [smoke]\n  query: select scenario, episode, avg(mean) as value from forces where episode \
             is not null group by scenario, episode\n  condition: above -1\n"
        )
    };
    std::fs::write(&file, claim("there_are_forces") + &claim("links_feel_forces")).unwrap();
    let all = ["claims", "--all", "--file", file.to_str().unwrap()];
    let one = [&all[..], &["links_feel_forces"]].concat();
    for width in WIDTHS {
        for (arguments, claims) in [(&all[..], 2), (&one[..], 1)] {
            let said = on_terminal(FOLDER.path(), width, arguments);
            for scenario in ["empty", "cluttered"] {
                let of_scenario =
                    said.lines().filter(|line| line.contains(scenario) && line.contains("holds"));
                let with_value = of_scenario.filter(|line| line.contains('[') && line.contains(']'));
                assert_eq!(with_value.count(), claims, "{scenario} at {width}: {said}");
            }
            // The query of a single claim is printed as it is in the file.
            assert!(claims == 1 || too_wide(&said, width).is_empty(), "at {width}: {said}");
        }
    }
    let (root, width) = (Path::new(env!("CARGO_MANIFEST_DIR")), WIDTHS[0]);
    let said = on_terminal(root, width, &["--results", "results/reference", "claims", "--all"]);
    assert!(too_wide(&said, width).is_empty(), "at {width}: {said}");
}

#[test]
fn metrics_that_are_the_same_in_two_runs_are_not_listed() {
    let folder = tempfile::tempdir().unwrap();
    let results = folder.path().to_str().unwrap();
    let smoke = crate::common::SMOKE;
    crate::common::succeed(
        folder.path(),
        &["run", smoke, "scenarios=[empty]", "latent=[2,4]", "tasks=[prediction]"],
    );
    let said =
        on_terminal(FOLDER.path(), 80, &["--results", results, "diff", "--all", "empty-z2", "empty-z4"]);
    // Four metrics in each of two directions, and over both: overall and on the ground. Two without a contact. Those of
    // contacts and their phases are over both. Those of the baselines are equal.
    assert_eq!(said.matches("\ncontact force ").count(), 3 * (4 + 4 + 2) + 26, "{said}");
    let same =
        "the same in both: prediction of persistence, prediction of ridge, prediction of training mean";
    assert!(said.replace('\n', " ").contains(same), "{said}");
    let itself =
        on_terminal(FOLDER.path(), 80, &["--results", results, "diff", "--all", "empty-z2", "empty-z2"]);
    let same = "no metric differs; the same in both: prediction of network, prediction of persistence, ";
    assert!(itself.replace('\n', " ").contains(same), "{itself}");

    // Metrics of a failed run do not count.
    let mut runs =
        std::fs::read_dir(folder.path().join("runs/smoke")).unwrap().map(|run| run.unwrap().path());
    let run = runs.find(|run| run.file_name().unwrap().to_str().unwrap().starts_with("empty-z2")).unwrap();
    let record_path = run.join("run.json");
    let mut record: Value = serde_json::from_slice(&std::fs::read(&record_path).unwrap()).unwrap();
    record["status"] = "failed".into();
    record[seal::KEY] = seal::BLANK.into();
    seal::write(&record_path, format!("{record:#}\n").into_bytes()).unwrap();
    let failed = on_terminal(FOLDER.path(), 80, &["--results", results, "diff", "empty-z2", "empty-z2"]);
    assert!(failed.ends_with("\nneither of the runs has metrics\n"), "{failed}");
}

#[test]
fn an_example_is_above_what_it_does_where_it_is_too_wide() {
    let said = on_terminal(FOLDER.path(), 60, &["completions", "--help"]);
    assert!(said.contains("\n  harness completions zsh > ~/.zfunc/_harness\n      with fpath"), "{said}");
    let said = on_terminal(FOLDER.path(), 60, &["submit", "--help"]);
    assert!(said.contains("--throttle 8") && !said.contains("--throttle \\\n"), "{said}");
}
