//! `harness compare` on real runs: in every format, the numbers are those of the tables.

use crate::common::{SMOKE, ask, copy_folder, divide, finish, fresh, harness, succeed};
use crate::report::PENDULUM;
use crate::terminal::{plain, raw, too_wide};
use harness::metrics::rounded;
use harness::numbers::by_value;
use harness::registry::Registry;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

/// Runs of two latent sizes with two seeds each in the empty scenario, and two runs in the cluttered scenario.
static RESULTS: LazyLock<PathBuf> = LazyLock::new(|| {
    let results = Path::new(env!("CARGO_TARGET_TMPDIR")).join("compare");
    let _ = std::fs::remove_dir_all(&results);
    for settings in [["scenarios=[empty]", "latent=[2,4]"], ["scenarios=[cluttered]", "latent=[4]"]] {
        succeed(&results, &[&["run", SMOKE, "seeds=[0,1]"], &settings[..]].concat());
    }
    results
});

/// The values of a metric for all seeds, by column of `harness compare smoke --by latent`.
fn values(task: &str, scenario: &str, modality: &str, metric: &str) -> BTreeMap<String, Vec<f64>> {
    let mut values: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    let sql = format!(
        "select model, latent, value from metrics where task = '{task}' and scenario = '{scenario}' and modality = \
         '{modality}' and metric = '{metric}' and index is null and direction is null and value is not null"
    );
    for row in ask(&RESULTS, &sql) {
        let column = match row["model"].as_str().unwrap() {
            "network" => format!("latent {}", row["latent"]),
            baseline => baseline.replace('_', " "),
        };
        values.entry(column).or_default().push(row["value"].as_f64().unwrap());
    }
    values
}

/// The expected text of a cell: the mean and, for two seeds that differ by d, half of Student's interval, 12.706 d / 2.
fn expected(column: &str, values: &[f64], decimals: usize) -> String {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    if !column.starts_with("latent") {
        return format!("{mean:.decimals$}");
    }
    let [a, b] = values else { panic!("two seeds, not {values:?}") };
    format!("{mean:.decimals$} ± {:.decimals$}", 12.706_204_736 * (a - b).abs() / 2.0)
}

/// The cells of a Markdown table: its header, and its rows.
fn markdown(text: &str) -> (Vec<&str>, Vec<Vec<&str>>) {
    let mut lines = text.lines().take_while(|line| line.starts_with('|')).map(|line| {
        let cells = line.strip_prefix("| ").unwrap().strip_suffix(" |").unwrap();
        cells.split(" | ").map(str::trim).collect::<Vec<_>>()
    });
    let header = lines.next().unwrap();
    assert!(lines.next().unwrap().iter().all(|cell| ["---", "---:"].contains(cell)));
    let rows: Vec<Vec<&str>> = lines.collect();
    assert!(rows.iter().all(|row| row.len() == header.len()), "{text}");
    (header, rows)
}

#[test]
fn cells_are_means_and_intervals_of_tables_with_the_best_bold() {
    let printed = succeed(&RESULTS, &["compare", "smoke", "--format", "markdown"]);
    let (header, rows) = markdown(&printed);
    assert_eq!(header, ["", "", "", "", "latent 2", "latent 4", "persistence", "ridge", "training mean"]);
    // Each scenario has five rows of the prediction (two metrics of proprioception, two of force, one of the frame
    // difference) and three of the reconstruction (two metrics and one).
    assert_eq!(rows.len(), 2 * (5 + 3), "{printed}");
    for row in &rows {
        let [task, scenario, modality, metric] = row[..4] else { panic!("{row:?}") };
        let (metric, decimals) = match metric {
            "SMAPE (%)" => ("smape", 2),
            "WMAPE (%)" => ("wmape", 2),
            "R2" => ("r2", 3),
            "relative error" => ("relative_error", 3),
            other => panic!("{other}"),
        };
        let values = values(task, scenario, &modality.replace(' ', "_"), metric);
        let mean = |values: &Vec<f64>| values.iter().sum::<f64>() / values.len() as f64;
        let means = values.values().map(mean);
        let best = if metric == "r2" { means.max_by(f64::total_cmp) } else { means.min_by(f64::total_cmp) };
        for (column, cell) in header[4..].iter().zip(&row[4..]) {
            let Some(values) = values.get(*column) else {
                assert_eq!(*cell, "", "{row:?}");
                continue;
            };
            let number = expected(column, values, decimals);
            // Means that are printed alike are equally good.
            let bold = format!("{:.decimals$}", mean(values)) == format!("{:.decimals$}", best.unwrap());
            let expected = if bold { format!("**{number}**") } else { number };
            assert_eq!(*cell, expected, "{column} of {row:?}");
        }
    }
    assert!(
        printed.ends_with(
            "\n\nsmoke; mean ± half of the 95 % interval over 2 seeds; predictions of the next sample; bold: the best of its \
             row\n"
        )
    );
}

#[test]
fn a_setting_is_compared_with_the_whole_spec_of_a_run() {
    let all = succeed(&RESULTS, &["compare", "smoke", "--format", "markdown"]);
    // Defaults that a record does not store, and values in every way in which a spec can give them. The smoke
    // experiment has hidden: [16], and the networks see joint angles and images.
    for setting in [
        "split.by=episode",
        "split.gap_seconds=null",
        "training.dropout=0",
        "training.schedule=constant",
        "training.clip_norm=null",
        "training.losses.contact_force=squared",
        "network.fusion=early",
        "network.average=1",
        "scaling.contact_force.scale=shared",
        "simulation.factors=[]",
        "network.hidden=16",
        "network.hidden=[16]",
        "network.hidden=1.6e1",
        "input=[vision, proprioception]",
        "input=[proprioception,vision]",
        "tasks=[prediction, reconstruction]",
        "variant=",
    ] {
        let chosen = succeed(&RESULTS, &["compare", "smoke", "--format", "markdown", "--where", setting]);
        assert_eq!(chosen, all, "{setting}");
    }
    for (setting, expected) in [
        ("split.by=time", "no finished run has split.by=time; finished runs have split.by (episode)"),
        ("network.hidden=[32, 32]", "finished runs have network.hidden ([16])"),
        (
            "tasks=[reconstruction, prediction]",
            "finished runs have tasks ([\"prediction\",\"reconstruction\"])",
        ),
        (
            "training.dropout=0.5",
            "no finished run has training.dropout=0.5; finished runs have training.dropout (0.0)",
        ),
        ("split.buy=episode", "no run has a setting 'split.buy'; did you mean 'split.by'?"),
    ] {
        let answer = finish(&mut harness(&RESULTS, &["compare", "smoke", "--where", setting]));
        assert!(answer.code == 2 && answer.stderr.contains(expected), "{setting}: {}", answer.stderr);
    }
}

#[test]
fn an_experiment_without_a_chosen_run_is_not_said_to_have_none() {
    let results = fresh("compare_chosen");
    let run = |settings: &[&str]| {
        let run = ["run", SMOKE, "scenarios=[empty]", "tasks=prediction", "training.epochs=1"];
        succeed(&results, &[&run[..], settings].concat())
    };
    run(&["name=first"]);
    run(&["name=second", "simulation.seed=1"]);
    run(&["name=second", "latent=2"]);
    for (arguments, expected) in [
        (
            &["first", "second", "--where", "simulation.seed=1"][..],
            "no finished run of 'first' has simulation.seed=1; its finished runs have simulation.seed (0)",
        ),
        (
            &["second", "--where", "simulation.seed=1", "--where", "latent=2"],
            "no finished run of 'second' has simulation.seed=1 and latent=2; its finished runs have latent (2, 4) and \
             simulation.seed (0, 1)",
        ),
        (
            &["third", "--where", "simulation.seed=1"],
            "'third' has no finished runs; those that have: first, second",
        ),
    ] {
        let answer = finish(&mut harness(&results, &[&["compare"], arguments].concat()));
        assert!(answer.stderr.contains(expected), "{}", answer.stderr);
    }
}

#[test]
fn runs_that_differ_in_more_than_their_seed_are_never_averaged() {
    let results = fresh("compare_settings");
    let run =
        |settings: &[&str]| succeed(&results, &[&["run", SMOKE, "scenarios=[empty]"], settings].concat());
    run(&["training.batch_size=16"]);
    run(&["training.batch_size=64"]);
    run(&["training.batch_size=64", "seeds=[1]"]);
    run(&["training.batch_size=16", "training.epochs=5", "seeds=[2]"]);
    let compare = |more: &[&str]| {
        let arguments = [
            "compare",
            "smoke",
            "--metrics",
            "r2",
            "--models",
            "network",
            "--task",
            "prediction",
            "--format",
            "markdown",
        ];
        succeed(&results, &[&arguments[..], more].concat())
    };
    let values = |runs: &str| {
        let rows = ask(
            &results,
            &format!(
                "select modality, value from metrics where run in ({runs}) and task = 'prediction' and model = \
                 'network' and metric = 'r2' and index is null and direction is null order by modality, seed"
            ),
        );
        let values = |modality: &str| -> Vec<f64> {
            let of = rows.iter().filter(|row| row["modality"] == modality);
            of.map(|row| row["value"].as_f64().unwrap()).collect()
        };
        ["proprioception", "contact_force"].map(values)
    };
    let run_of = |batch: u64, epochs: u64| -> String {
        let found = std::fs::read_dir(results.join("runs/smoke")).unwrap().map(|entry| entry.unwrap().path());
        let record = |path: &PathBuf| -> serde_json::Value {
            serde_json::from_slice(&std::fs::read(path.join("run.json")).unwrap()).unwrap()
        };
        let runs = found.map(|path| record(&path)).filter(|record| {
            let training = &record["spec"]["training"];
            training["batch_size"] == batch && training["epochs"] == epochs
        });
        runs.map(|record| format!("'{}'", record["run"].as_str().unwrap())).collect::<Vec<_>>().join(", ")
    };
    // In SQL, runs with the same `group_hash` are a group.
    let sql = "select group_hash, count(distinct run) as runs, avg(value) as value from metrics \
               join runs using (experiment, run) where task = 'prediction' and model = 'network' and metric = 'r2' \
               and index is null and direction is null and modality = 'contact_force' \
               group by group_hash order by runs desc, value";
    let groups = ask(&results, sql);
    let mut by_hand: Vec<(usize, f64)> = [(64, 2), (16, 2), (16, 5)]
        .map(|(batch, epochs)| {
            let [_, forces] = values(&run_of(batch, epochs));
            (forces.len(), forces.iter().sum::<f64>() / forces.len() as f64)
        })
        .to_vec();
    by_hand.sort_by(|a, b| b.0.cmp(&a.0).then(a.1.total_cmp(&b.1)));
    assert_eq!(groups.len(), by_hand.len());
    for (group, (runs, value)) in groups.iter().zip(by_hand) {
        assert_eq!(group["runs"].as_u64(), Some(runs as u64));
        assert!((group["value"].as_f64().unwrap() - value).abs() < 1e-12, "{group}");
    }

    let printed = compare(&[]);
    let (header, rows) = markdown(&printed);
    assert_eq!(header, ["", "", "latent 4"]);
    assert_eq!(rows.len(), 2 * 3, "{printed}");
    for (batch, epochs) in [(16, 2), (16, 5), (64, 2)] {
        let settings = format!("training.batch_size={batch}, training.epochs={epochs}");
        let [angles, forces] = values(&run_of(batch, epochs));
        for (modality, values) in [("proprioception", angles), ("contact force", forces)] {
            let row = rows.iter().find(|row| row[0] == settings && row[1] == modality);
            let row = row.unwrap_or_else(|| panic!("no {settings}, {modality} in {printed}"));
            let number = match values.as_slice() {
                [one] => format!("{one:.3}"),
                _ => expected("latent 4", &values, 3),
            };
            assert_eq!(row[2], number, "{settings}, {modality}");
        }
    }
    assert!(
        printed.contains(
            "\n\nprediction; smoke; empty; R2; mean ± half of the 95 % interval over 1 to 2 seeds; "
        )
    );
    // All settings in columns, and then one of them.
    let beside = compare(&["--by", "settings"]);
    let (header, _) = markdown(&beside);
    assert_eq!(
        header[1..],
        [
            "training.batch_size=16, training.epochs=2",
            "training.batch_size=16, training.epochs=5",
            "training.batch_size=64, training.epochs=2"
        ]
    );
    let alone = compare(&["--where", "training.batch_size=64"]);
    let (header, rows) = markdown(&alone);
    assert_eq!((header, rows.len()), (vec!["", "latent 4"], 2));
    assert!(alone.contains("over 2 seeds"), "{alone}");
}

#[test]
fn baselines_are_in_the_rows_of_all_networks_compared_with_them() {
    // Without the latent size in the columns, the rows have it, but baselines have no latent size.
    let printed =
        succeed(&RESULTS, &["compare", "--by", "scenario", "--metrics", "r2", "--format", "markdown"]);
    let (header, rows) = markdown(&printed);
    let persistence = header.iter().position(|name| *name == "persistence, empty").unwrap();
    assert!(rows.iter().all(|row| row.contains(&"latent 2") || row.contains(&"latent 4")), "{printed}");
    let empty = header.iter().position(|name| *name == "empty").unwrap();
    for row in rows.iter().filter(|row| row[0] == "prediction") {
        assert!(!row[empty].is_empty() && !row[persistence].is_empty(), "{row:?} in {printed}");
    }
    // The scenarios have different samples, so their baselines differ. The columns of equal ones are one column.
    let results = fresh("compare_baselines");
    for name in ["name=one", "name=two"] {
        let settings = ["scenarios=[empty]", "tasks=[prediction]", name];
        succeed(&results, &[&["run", SMOKE, "latent=[2,4]"], &settings[..]].concat());
    }
    let printed = succeed(&results, &["compare", "--by", "experiment", "--format", "markdown"]);
    let (header, rows) = markdown(&printed);
    assert_eq!(header[3..], ["one", "two", "persistence", "ridge", "training mean"]);
    // Two latent sizes, and five metrics of each.
    assert_eq!(rows.len(), 2 * 5, "{printed}");
}

#[test]
fn no_number_or_arrow_of_a_comparison_is_broken_at_any_width() {
    for width in [60, 80, 120] {
        let mut compare = std::process::Command::new(env!("CARGO_BIN_EXE_harness"));
        compare.arg("--results").arg(&*RESULTS).args(["compare", "smoke"]);
        let said = plain(&raw(&mut compare, width));
        assert!(too_wide(&said, width).is_empty(), "at {width}: {said}");
        for line in said.lines().take_while(|line| !line.starts_with("smoke; mean ±")) {
            let words: Vec<&str> = line.split_whitespace().collect();
            assert!(!["±", "↑", "↓"].contains(words.first().unwrap_or(&"")), "at {width}: {said}");
            assert!(words.last() != Some(&"±"), "at {width}: {said}");
        }
    }
}

/// Each of the networks' inputs has its own ridge regression.
#[test]
fn many_columns_of_a_text_are_rows() {
    let results = fresh("compare_many_columns");
    let senses = ["proprioception", "arm", "contact_force", "contact_force_mean"];
    let labels = (1..1 << senses.len()).map(|chosen| {
        let input = (0..senses.len()).filter(|sense| chosen >> sense & 1 == 1).map(|sense| senses[sense]);
        let input: Vec<&str> = input.collect();
        let label = if input.len() == senses.len() { "all_senses".into() } else { input.join("_and_") };
        format!("{label}: {{input: [{}]}}", input.join(", "))
    });
    let labels = labels.collect::<Vec<_>>().join(", ");
    let vary = format!("vary={{senses: {{{labels}}}}}");
    let more = [
        "scenarios=empty",
        "output=[proprioception, contact_force]",
        "tasks=prediction",
        "training.epochs=1",
    ];
    let network = ["network.preset=single_to_multi", &vary];
    succeed(&results, &[&["run", SMOKE][..], &more, &network].concat());
    let print = |option: &[&str]| succeed(&results, &[&["compare", "smoke"][..], option].concat());
    let (short, all) = (print(&[]), print(&["--all"]));
    assert!(short.lines().all(|line| line.chars().count() < 170 || line.contains("; ")), "{short}");
    let row = |text: &str| text.lines().find(|line| line.starts_with("all_senses ")).unwrap().to_owned();
    let last = |text: &str| row(text).split_whitespace().last().unwrap().to_owned();
    assert!(last(&short).parse::<f64>().is_ok() && last(&short) == last(&all), "{short}\n{all}");
    assert!(short.contains("* the best of its column"), "{short}");
    assert!(
        !short.contains("\nridge, ") && short.contains("; ridge of each column is left out; --all shows it"),
        "{short}"
    );
    assert!(all.contains("\nridge, all_senses ") && !all.contains("left out"), "{all}");
    // The name of an axis is a key.
    assert_eq!(row(&print(&["--by", "senses"])), row(&short));
    let wrong = finish(&mut harness(&results, &["compare", "smoke", "--by", "sensors"]));
    assert!(wrong.code == 2 && wrong.stderr.contains("'sensors'"), "{}", wrong.stderr);
    assert!(wrong.stderr.contains("an axis of these runs: senses"), "{}", wrong.stderr);
}

/// Options of a random question about runs of the experiment `smoke`.
fn random_question(random: &mut impl Rng) -> Vec<String> {
    let choices: [(&str, &[&str]); 9] = [
        (
            "--metrics",
            &["r2", "rmse", "mae", "wmape,r2", "skill", "skill_horizon", "relative_error", "kl,active"],
        ),
        (
            "--of",
            &[
                "contact_force",
                "proprioception",
                "vision",
                "contact_force,proprioception",
                "frame_difference",
            ],
        ),
        ("--models", &["network", "network,persistence", "ridge", "persistence,training_mean"]),
        ("--task", &["prediction", "reconstruction"]),
        ("--horizon", &["1", "2", "4", "1,4", "0.1s", "0.4s"]),
        ("--by", &["latent", "scenario", "latent,scenario", "horizon", "experiment", "input", "variant"]),
        ("--where", &["latent=4", "scenario=empty", "seed=0"]),
        ("--against", &["latent 4", "persistence", "network"]),
        ("--interval", &["mean", "next-dataset"]),
    ];
    let mut question = Vec::new();
    for (option, values) in choices {
        if random.random_bool(0.35) {
            question.extend([option.to_owned(), values[random.random_range(0..values.len())].to_owned()]);
        }
    }
    question
}

/// The numbers of a table of documents as they are printed: the cells below headings, without marks.
fn numbers(header: &[&str], rows: &[Vec<&str>]) -> BTreeSet<String> {
    let first = header.iter().take_while(|title| title.is_empty()).count();
    let cells = rows.iter().flat_map(|row| &row[first..]).filter(|cell| !cell.is_empty());
    cells.map(|cell| cell.replace("**", "")).collect()
}

/// Asks random questions in every format. Either all answers have the same numbers, or all say the same why there is
/// none.
fn check_renderings(questions: usize) {
    let mut random = ChaCha8Rng::seed_from_u64(45);
    let (folder, mut answered) = (tempfile::tempdir().unwrap(), 0);
    let plot = folder.path().join("plot.csv").display().to_string();
    for place in 0..questions {
        let results = if place % 2 == 0 { &*RESULTS } else { &*crate::horizons::RESULTS };
        let question = random_question(&mut random);
        let ask = |command: &str, more: &[&str]| {
            let options = question.iter().map(String::as_str).chain(more.iter().copied());
            finish(&mut harness(results, &[command, "smoke"].into_iter().chain(options).collect::<Vec<_>>()))
        };
        let printed = |format: &str| ask("compare", &["--format", format]);
        let json = printed("json");
        if json.code != 0 {
            for format in ["text", "markdown", "latex", "csv"] {
                assert_eq!(
                    (printed(format).code, printed(format).stderr),
                    (2, json.stderr.clone()),
                    "{question:?}"
                );
            }
            continue;
        }
        answered += 1;
        let means: Vec<Value> = serde_json::from_str(&json.stdout).unwrap();
        let expected: BTreeSet<String> = means.iter().map(cell).collect();
        let text = printed("markdown").stdout;
        let (header, rows) = markdown(&text);
        assert_eq!(numbers(&header, &rows), expected, "{question:?}: {text}");
        let latex = printed("latex").stdout.replace(r"\pm", "±");
        let whole = ask("compare", &["--all"]).stdout;
        for number in &expected {
            assert!(latex.contains(number.as_str()), "{question:?}: no {number} in {latex}");
            let [mean, half] = [0, 1].map(|part| number.split(" ± ").nth(part).unwrap_or(""));
            assert!(whole.contains(mean) && whole.contains(half), "{question:?}: no {number} in {whole}");
        }
        let csv = printed("csv").stdout;
        assert_eq!(csv.lines().count(), 1 + means.len());
        // The file of a plot has the means of the table of its models and its task.
        let drawn = ask("plot", &["--x", "modality", "--facet", "scenario", "--output", &plot]);
        if drawn.code == 0
            && !["--by", "--against"].iter().any(|option| question.iter().any(|word| word == option))
        {
            let usual = [["--models", "network"], ["--task", "prediction"]];
            let more = usual.iter().filter(|[option, _]| !question.iter().any(|word| word == option));
            let more: Vec<&str> = more.flatten().copied().chain(["--format", "csv"]).collect();
            assert_eq!(std::fs::read_to_string(&plot).unwrap(), ask("compare", &more).stdout, "{question:?}");
        }
    }
    assert!(answered > questions / 4, "only {answered} questions have an answer");
}

/// The text of a mean and half of its interval.
fn cell(mean: &Value) -> String {
    let unit = mean["unit"].as_str().unwrap();
    let value = mean["mean"].as_f64().unwrap_or(f64::NEG_INFINITY);
    let sign =
        if mean["difference_from"].is_string() && !rounded(value, unit).starts_with('-') { "+" } else { "" };
    let half = mean["high"].as_f64().map(|high| format!(" ± {}", rounded(high - value, unit)));
    format!("{sign}{}{}", rounded(value, unit), half.unwrap_or_default())
}

#[test]
fn every_rendering_of_a_question_has_the_same_numbers() {
    check_renderings(30);
}

#[test]
#[ignore = "minutes: `make soak` runs it"]
fn every_rendering_of_300_questions_has_the_same_numbers() {
    check_renderings(300);
}

#[test]
fn a_table_for_latex_has_the_words_of_the_others() {
    let arguments = ["compare", "--by", "scenario,latent", "--task", "prediction", "--metrics", "r2,rmse"];
    let print = |format: &str| succeed(&RESULTS, &[&arguments[..], &["--format", format]].concat());
    let (markdown_text, text, latex) = (print("markdown"), print("text"), print("latex"));
    let (header, _) = markdown(&markdown_text);
    assert_eq!(header[2..5], ["empty, latent 2", "empty, latent 4", "cluttered, latent 4"]);
    assert_eq!(header[5..7], ["persistence, empty", "persistence, cluttered"]);
    let (table, note) = text.split_once("\n\n").unwrap();
    assert!(header.iter().all(|name| table.contains(name)) && table.contains("R2 ↑"), "{table}");
    assert!(note.ends_with("; ↑ higher is better, ↓ lower is better\n"), "{note}");
    let lines: Vec<&str> = latex.lines().collect();
    assert_eq!(
        lines[0],
        "% prediction; smoke; mean ± half of the 95 % interval over 2 seeds; predictions of the next sample; bold: the best \
         of its row"
    );
    assert_eq!(lines[1], format!("\\begin{{tabular}}{{ll{}}}", "r".repeat(header.len() - 2)));
    assert_eq!(lines[2..5], ["\\toprule", &format!("{} \\\\", header.join(" & ")), "\\midrule"]);
    assert_eq!(lines[lines.len() - 2..], ["\\bottomrule", "\\end{tabular}"]);
    assert!(latex.contains(" & $R^2$ & ") && latex.contains("RMSE (rad)"), "{latex}");
}

#[test]
fn a_table_of_text_has_no_empty_column() {
    let text = succeed(&RESULTS, &["compare", "smoke"]);
    let table = |title: &str| text.split("\n\n").find(|part| part.starts_with(title)).unwrap().to_owned();
    assert!(table("prediction, empty\n").contains("latent 2"), "{text}");
    let cluttered = table("prediction, cluttered\n");
    assert!(cluttered.contains("latent 4") && !cluttered.contains("latent 2"), "{text}");
}

#[test]
fn variants_are_in_the_order_of_the_spec() {
    let results = fresh("compare_variants");
    let settings =
        ["scenarios=[empty]", "tasks=[prediction]", "latent=[16,2]", "vary={network.hidden: [[16], [8]]}"];
    succeed(&results, &[&["run", SMOKE], &settings[..]].concat());
    let arguments = ["compare", "smoke", "--by", "variant", "--models", "network", "--format", "markdown"];
    let printed = succeed(&results, &arguments);
    let (header, _) = markdown(&printed);
    let places = ["hidden=8", "hidden=16"]
        .map(|name| header.iter().position(|title| title.replace(['[', ']'], "") == name).expect(&printed));
    assert!(places[1] < places[0], "{printed}");
    let listed = succeed(&results, &["ls"]);
    assert!(listed.find("empty-z2-").unwrap() < listed.find("empty-z16-").unwrap(), "{listed}");
}

/// The means of R2 of the networks over all runs, by variant. The runs have one output.
fn by_variant(results: &Path) -> BTreeMap<String, f64> {
    let sql = "select variant, avg(value) as value from metrics where model = 'network' and metric = 'r2' and index is \
               null and direction is null group by variant";
    let rows = ask(results, sql);
    rows.iter()
        .map(|row| (row["variant"].as_str().unwrap().to_owned(), row["value"].as_f64().unwrap()))
        .collect()
}

/// The arguments that compare two metrics of the networks of the experiment `smoke` as Markdown.
const OF_NETWORKS: [&str; 8] =
    ["compare", "smoke", "--models", "network", "--metrics", "r2,rmse", "--format", "markdown"];

#[test]
fn an_ablation_of_the_input_is_one_table() {
    let results = fresh("compare_ablation");
    // Without an image a network has no convolutions, and its inputs have other scales. Neither is a difference.
    let inputs =
        "vary={input: [[vision], [vision, proprioception], [proprioception]], simulation.seed: [0, 1]}";
    let settings =
        ["scenarios=[empty]", "tasks=[prediction]", "output=[proprioception]", "seeds=[0,1]", inputs];
    succeed(&results, &[&["run", SMOKE], &settings[..]].concat());
    let printed = succeed(&results, &OF_NETWORKS);
    let (header, rows) = markdown(&printed);
    assert_eq!(header[1..], ["vision", "proprioception + vision", "proprioception"], "{printed}");
    assert_eq!(rows.iter().map(|row| row[0]).collect::<Vec<_>>(), ["R2", "RMSE (rad)"], "{printed}");
    let means = by_variant(&results);
    for (cell, variant) in rows[0][1..].iter().zip(["vision", "vision+proprioception", "proprioception"]) {
        let mean = format!("{:.3}", means[&format!("input={variant}")]);
        assert!(cell.trim_matches('*').starts_with(&mean), "{cell} of {variant}, not {mean}");
    }
    assert!(printed.contains("over 2 datasets (4 runs)"), "{printed}");
    assert_eq!(succeed(&results, &[&OF_NETWORKS[..], &["--by", "input"]].concat()), printed);
    let by_variant = succeed(&results, &[&OF_NETWORKS[..], &["--by", "variant"]].concat());
    assert_eq!(by_variant, printed);

    let path = |name: &str| results.join(name).display().to_string();
    for name in ["plot.svg", "plot.csv"] {
        succeed(&results, &["plot", "smoke", "--x", "input", "--metrics", "r2", "--output", &path(name)]);
    }
    let svg = std::fs::read_to_string(path("plot.svg")).unwrap();
    let places = ["vision", "proprioception + vision", "proprioception"]
        .map(|name| svg.find(&format!("aria-label=\"{name}\"")).unwrap_or_else(|| panic!("no {name}")));
    assert!(places.is_sorted(), "{places:?}");
    let csv = std::fs::read_to_string(path("plot.csv")).unwrap();
    assert!(csv.lines().next().unwrap().contains(",settings,input,horizon,task,"), "{csv}");
    assert_eq!(csv.lines().count(), 1 + 3);
}

#[test]
fn roles_and_inputs_without_one_modality_have_short_names() {
    let results = fresh("compare_roles");
    std::fs::create_dir_all(&results).unwrap();
    let spec = |name: &str, more: &str| {
        let smoke = std::fs::read_to_string(SMOKE).unwrap();
        let kept = smoke.lines().filter(|line| !line.starts_with("name:") && !line.starts_with("output:"));
        let path = results.join(format!("{name}.yaml"));
        let text = kept.collect::<Vec<_>>().join("\n");
        std::fs::write(&path, format!("name: {name}\noutput: [contact_force]\n{text}\n{more}")).unwrap();
        let path = path.display().to_string();
        let settings = ["scenarios=[empty]", "tasks=[prediction]", "training.epochs=1"];
        succeed(&results, &[&["run", &path][..], &settings].concat());
    };
    let header = |name: &str, by: &[&str]| -> Vec<String> {
        let arguments =
            ["compare", name, "--models", "network", "--metrics", "r2,rmse", "--format", "markdown"];
        let printed = succeed(&results, &[&arguments[..], by].concat());
        let header = printed.lines().next().unwrap().split('|').map(|cell| cell.trim().to_owned());
        header.filter(|cell| !cell.is_empty()).collect()
    };
    spec("roles", "vary: {role: {touch: {input: [contact_force]}, no_touch: {input: [proprioception]}}}\n");
    assert_eq!(header("roles", &[]), ["touch", "no_touch"]);
    assert_eq!(header("roles", &["--by", "input"]), ["contact_force", "proprioception"]);
    spec(
        "each",
        "vary:\n  input: [[vision, arm, proprioception], [arm, proprioception], [vision, proprioception]]\n",
    );
    assert_eq!(header("each", &[]), ["all inputs", "without vision", "without arm"]);
    assert_eq!(header("each", &["--by", "input"]), ["all inputs", "without vision", "without arm"]);
}

#[test]
fn means_are_told_apart_by_any_varied_setting() {
    let results = fresh("compare_settings_of_variants");
    let settings = ["scenarios=[empty]", "tasks=[prediction]", "output=[proprioception]"];
    let varied = "vary={network.hidden: [[16], [8]], training.epochs: [2, 1]}";
    succeed(&results, &[&["run", SMOKE, varied], &settings[..]].concat());
    let means = by_variant(&results);
    for key in ["network.hidden", "hidden"] {
        let printed = succeed(&results, &[&OF_NETWORKS[..], &["--by", key]].concat());
        let (header, rows) = markdown(&printed);
        assert_eq!(header[2..], ["hidden=16", "hidden=8"], "{printed}");
        let rows: Vec<_> = rows.into_iter().filter(|row| row[1] == "R2").collect();
        assert_eq!(
            rows.iter().map(|row| row[0]).collect::<Vec<_>>(),
            ["training.epochs=1", "training.epochs=2"]
        );
        for (row, epochs) in rows.iter().zip([1, 2]) {
            for (cell, hidden) in row[2..].iter().zip([16, 8]) {
                let mean = means[&format!("hidden={hidden},epochs={epochs}")];
                assert_eq!(cell.trim_matches('*'), format!("{mean:.3}"), "{printed}");
            }
        }
    }
    let refused = finish(&mut harness(&results, &[&OF_NETWORKS[..], &["--by", "hiden"]].concat()));
    assert!(
        refused
            .stderr
            .starts_with("error: there is no key 'hiden'; did you mean 'network.hidden'? allowed: "),
        "{}",
        refused.stderr
    );
    // A setting that no variant names is never hidden, even if each value of the key has one value of it.
    succeed(
        &results,
        &[&["run", SMOKE, "vary={network.hidden: [[4]]}", "training.batch_size=32"], &settings[..]].concat(),
    );
    let printed = succeed(&results, &[&OF_NETWORKS[..], &["--by", "hidden"]].concat());
    assert!(printed.contains("training.batch_size=32"), "{printed}");
}

#[test]
fn intervals_over_datasets_are_said_to_be_over_datasets() {
    let results = fresh("compare_datasets");
    let settings =
        ["scenarios=[empty]", "tasks=[prediction]", "seeds=[0,1]", "vary={simulation.seed: [0, 1, 2]}"];
    succeed(&results, &[&["run", SMOKE], &settings[..]].concat());
    let text = succeed(&results, &["compare", "smoke", "--metrics", "smape"]);
    assert!(text.contains("95 % interval over 3 datasets (6 runs)"), "{text}");
    let file = results.join("means.csv").display().to_string();
    succeed(&results, &["compare", "smoke", "--metrics", "smape", "--models", "network", "--output", &file]);
    let means = std::fs::read_to_string(&file).unwrap();
    assert!(means.lines().next().unwrap().contains(",unit,better,datasets,seeds,mean,"), "{means}");
    assert!(means.lines().skip(1).all(|line| line.contains(",%,lower,3,6,")), "{means}");
    let both = finish(&mut harness(&results, &["compare", "--format", "latex", "--output", &file]));
    assert_eq!(both.code, 2);
    assert!(
        both.stderr.contains("--format is the format of the standard output, and the ending of '"),
        "{}",
        both.stderr
    );
    let plot = results.join("plot.svg").display().to_string();
    succeed(
        &results,
        &["plot", "smoke", "--x", "latent", "--metrics", "smape", "--by", "modality", "--output", &plot],
    );
    let plot = std::fs::read_to_string(plot).unwrap();
    assert!(plot.contains("bars: 95 % intervals over 3 datasets (6 runs)"), "{}", &plot[..2000]);
}

#[test]
fn differences_from_a_column_pair_equal_datasets_and_seeds() {
    let results = fresh("compare_difference");
    let settings = [
        "scenarios=[empty]",
        "tasks=[prediction]",
        "latent=[2, 4]",
        "vary={simulation.seed: [0, 1, 2]}",
        "training.epochs=1",
    ];
    succeed(&results, &[&["run", SMOKE], &settings[..]].concat());
    // A run of one latent size without its counterpart is left out.
    succeed(
        &results,
        &[&["run", SMOKE, "latent=4", "seeds=1"], &[settings[0], settings[1], settings[4]][..]].concat(),
    );
    let sql = "select run, latent, value from metrics where metric = 'rmse' and modality = 'contact_force' and model = \
               'network' and index is null and direction is null";
    let mut values: BTreeMap<String, [Option<f64>; 2]> = BTreeMap::new();
    for row in ask(&results, sql) {
        let (latent, run) = (row["latent"].as_u64().unwrap(), row["run"].as_str().unwrap());
        // empty-z4-data1-seed0-07b35321: what is between the latent size and the hash names dataset and seed.
        let (seeds, _hash) = run.split_once(&format!("z{latent}")).unwrap().1.rsplit_once('-').unwrap();
        values.entry(seeds.to_owned()).or_default()[usize::from(latent == 4)] = row["value"].as_f64();
    }
    let differences: Vec<f64> =
        values.values().filter_map(|[small, large]| Some((*large)? - (*small)?)).collect();
    assert_eq!((differences.len(), values.len()), (3, 4), "{values:?}");
    let mean = differences.iter().sum::<f64>() / 3.0;
    let squares: f64 = differences.iter().map(|difference| (difference - mean).powi(2)).sum();
    // Student's t for two degrees of freedom, times the standard error.
    let half = 4.302_652_73 * (squares / 2.0 / 3.0).sqrt();
    let signed = format!("{mean:+.4} ± {half:.4}");
    let arguments = ["compare", "smoke", "--metrics", "rmse", "--by", "latent", "--against", "latent 2"];
    let printed = succeed(&results, &[&arguments[..], &["--format", "markdown"]].concat());
    let (header, rows) = markdown(&printed);
    assert_eq!(header[2..], ["latent 2", "latent 4"], "{printed}");
    let force = rows.iter().find(|row| row[0] == "contact force").unwrap();
    assert_eq!(force[3].trim_matches('*'), signed, "{printed}");
    assert!(printed.contains("bold: differs with p < 0.05, corrected for all differences"), "{printed}");
    assert!(
        printed.contains("have the differences from latent 2, of runs with the same dataset and seed"),
        "{printed}"
    );
    let file = results.join("differences.csv").display().to_string();
    succeed(&results, &[&arguments[..], &["--output", &file]].concat());
    let csv = std::fs::read_to_string(&file).unwrap();
    assert_eq!(csv.lines().count(), 1 + 2 * rows.len(), "{csv}");
    // The rows of the column itself are no differences.
    let header: Vec<&str> = csv.lines().next().unwrap().split(',').collect();
    let place = |name: &str| header.iter().position(|column| *column == name).unwrap();
    let mut p_values: Vec<[f64; 2]> = Vec::new();
    for row in csv.lines().skip(1).map(|line| line.split(',').collect::<Vec<_>>()) {
        let from = if row[place("latent")] == "2" { "" } else { "latent 2" };
        assert_eq!(row[place("difference_from")], from, "{csv}");
        let number = |name: &str| row[place(name)].parse::<f64>();
        if let Ok(p) = number("p") {
            // With two degrees of freedom, the distribution function of Student's t has a closed form.
            let t = (number("mean").unwrap()
                / ((number("high").unwrap() - number("mean").unwrap()) / 4.302_652_73))
                .abs();
            p_values.push([1.0 - t / (2.0 + t * t).sqrt(), p]);
        }
    }
    p_values.sort_by(|a, b| a[0].total_cmp(&b[0]));
    assert_eq!(p_values.len(), rows.len());
    let mut holm: f64 = 0.0;
    for (rank, [raw, corrected]) in p_values.iter().enumerate() {
        holm = holm.max(raw * (p_values.len() - rank) as f64).min(1.0);
        assert!((corrected - holm).abs() < 1e-6, "{corrected}, not {holm}");
    }
    let refused = |arguments: &[&str]| finish(&mut harness(&results, arguments)).stderr;
    let unknown = refused(&["compare", "smoke", "--by", "latent", "--against", "latent 3"]);
    assert_eq!(
        unknown,
        "error: there is no column 'latent 3'; the columns are 'latent 2', 'latent 4', 'persistence', 'ridge', 'training mean'\n"
    );
    // A baseline has no seed, so each network is compared with it on the same dataset.
    let sql = "select avg(n.value - p.value) as gain, count(*) as runs from metrics n join metrics p on n.run = p.run \
               and n.task = p.task and n.modality = p.modality and n.metric = p.metric join runs r on r.run = n.run \
               where n.metric = 'rmse' and n.modality = 'contact_force' and n.model = 'network' and p.model = \
               'persistence' and n.latent = 4 and n.index is null and p.index is null and n.direction is null and \
               p.direction is null group by r.dataset";
    let datasets = ask(&results, sql);
    let gains: Vec<f64> = datasets.iter().map(|row| row["gain"].as_f64().unwrap()).collect();
    let runs: u64 = datasets.iter().map(|row| row["runs"].as_u64().unwrap()).sum();
    assert_eq!((gains.len(), runs), (3, 4));
    let file = results.join("gains.csv").display().to_string();
    let base = ["--by", "latent", "--against", "persistence", "--output", &file];
    succeed(&results, &[&["compare", "smoke", "--metrics", "rmse"], &base[..]].concat());
    let csv = std::fs::read_to_string(&file).unwrap();
    let mut rows = csv.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let header = rows.next().unwrap();
    let place = |name: &str| header.iter().position(|column| *column == name).unwrap();
    let (model, latent, modality) = (place("model"), place("latent"), place("modality"));
    let is_wanted =
        |row: &Vec<&str>| (row[model], row[latent], row[modality]) == ("network", "4", "contact_force");
    let row = rows.find(is_wanted).unwrap();
    assert_eq!((row[place("datasets")], row[place("seeds")]), ("3", "4"), "{csv}");
    let mean: f64 = row[place("mean")].parse().unwrap();
    assert!((mean - gains.iter().sum::<f64>() / 3.0).abs() < 1e-9, "{mean}, {gains:?}");
    let scenarios = refused(&["compare", "--by", "scenario", "--against", "empty"]);
    assert!(
        scenarios.contains("choose one with --where scenario=NAME, and leave scenario out"),
        "{scenarios}"
    );
}

const REFERENCE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/results/reference");

/// The values of a column of an answer in JSON, by those of another column.
fn column(answer: &str, of: &str, by: &str) -> BTreeMap<String, Value> {
    let rows: Vec<Value> = serde_json::from_str(answer).unwrap();
    rows.into_iter().map(|row| (row[by].to_string(), row[of].clone())).collect()
}

#[test]
fn whether_a_difference_is_significant_does_not_depend_on_what_its_interval_contains() {
    let of = ["compare", "shift", "--metrics", "r2", "--of", "contact_force", "--where", "senses=touch"];
    let against = ["--models", "network", "--against", "none", "--format", "json"];
    let p = |interval: &str| {
        let asked = [&of[..], &against, &["--interval", interval]].concat();
        column(&succeed(Path::new(REFERENCE), &asked), "p", "variant")
    };
    let of_mean = p("mean");
    assert_eq!((of_mean.len(), of_mean.values().filter(|p| p.is_number()).count()), (4, 3));
    assert_eq!(of_mean, p("next-dataset"));
}

#[test]
fn a_plot_of_differences_shows_them_alone_and_says_so() {
    let results = fresh("compare_plot");
    let file = |name: &str| results.join(name).display().to_string();
    let asked =
        ["--x", "senses", "--where", "scenario=cluttered", "--metrics", "r2", "--of", "contact_force"];
    for name in ["differences.svg", "differences.csv"] {
        let output = ["--against", "finger", "--output", &file(name)];
        succeed(Path::new(REFERENCE), &[&["plot", "which_sense"], &asked[..], &output].concat());
    }
    let drawn = std::fs::read_to_string(file("differences.svg")).unwrap();
    assert!(drawn.contains("<title>contact force, difference of R2 over senses</title>"));
    assert!(drawn.contains("differences from finger, of runs with the same dataset and seed"));
    // Those with touch are larger by twice the width of the intervals, which leaves room for all.
    assert!(!drawn.contains("beyond the axis"));
    let data = std::fs::read_to_string(file("differences.csv")).unwrap();
    let mut rows = data.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let place = rows.next().unwrap().iter().position(|name| *name == "difference_from").unwrap();
    assert_eq!(rows.map(|row| row[place]).collect::<Vec<_>>(), ["finger"; 5], "{data}");
}

#[test]
fn inputs_are_named_in_any_order_and_with_their_skill_horizons() {
    let asked = |more: &[&str]| {
        let of =
            ["compare", "missing", "--of", "contact_force", "--task", "prediction", "--models", "network"];
        let of_product = ["--where", "senses=product", "--format", "json"];
        succeed(Path::new(REFERENCE), &[&of[..], &of_product, more].concat())
    };
    let given = |names: &str| asked(&["--metrics", "r2", "--given", names]);
    assert_eq!(given("proprioception+arm"), given("arm, proprioception"));
    let by_given = |metric: &str| column(&asked(&["--metrics", metric, "--by", "given"]), "mean", "given");
    let keys = |found: &BTreeMap<String, Value>| found.keys().cloned().collect::<Vec<_>>();
    assert_eq!(keys(&by_given("skill_horizon")), keys(&by_given("skill")));
}

#[test]
fn two_runs_are_compared_at_their_horizon() {
    let registry = Registry::new(REFERENCE);
    let runs = registry.records().into_iter().filter(|run| {
        run.experiment == "hidden_stiffness"
            && run.run.contains("senses=touch,")
            && run.run.contains("-seed0-")
    });
    let runs: Vec<String> = runs.filter(|run| !run.run.contains("-data")).map(|run| run.name()).collect();
    assert_eq!(runs.len(), 2);
    let said = succeed(Path::new(REFERENCE), &["diff", &runs[0], &runs[1]]);
    assert!(said.contains("predictions 20 samples ahead"), "{said}");
    let sql = format!(
        "select value from all_metrics where experiment || '/' || run = '{}' and model = 'network' and metric = 'r2' \
         and modality = 'contact_force' and horizon = 20 and given is null and index is null and direction is null",
        runs[0]
    );
    let value = ask(Path::new(REFERENCE), &sql)[0]["value"].as_f64().unwrap();
    assert!(said.contains(&harness::metrics::rounded(value, "1")), "{value}: {said}");
}

/// Copies the published runs of two labels of `which_sense`. Those with the arm lack one dataset of the empty scenario.
fn without_one_dataset(name: &str) -> PathBuf {
    let (results, runs) = (fresh(name), "runs/which_sense");
    copy_folder(
        &Path::new(env!("CARGO_MANIFEST_DIR")).join("results/reference").join(runs),
        &results.join(runs),
    );
    divide(&results, |record| {
        let chosen = ["-z64-senses=finger-", "-z64-senses=arm-"];
        let left_out = record.run.starts_with("empty-z64-senses=arm-data2-");
        !left_out && chosen.iter().any(|label| record.run.contains(label))
    });
    results
}

#[test]
fn a_baseline_is_one_column_over_all_datasets() {
    let results = without_one_dataset("compare_baselines");
    let labels = ["senses=finger", "senses=arm"];
    let options = ["--models", "network,persistence", "--metrics", "r2", "--format", "markdown"];
    let chosen: Vec<&str> = labels.into_iter().flat_map(|label| ["--where", label]).collect();
    let printed = succeed(&results, &[&["compare", "which_sense"], &chosen[..], &options].concat());
    let (header, _) = markdown(&printed);
    assert_eq!(header[2..], ["finger", "arm", "persistence"], "{printed}");
    assert!(printed.contains("over 3 to 4 datasets"), "{printed}");
    let refused = finish(&mut harness(&results, &["compare", "which_sense", "--where", "sense=arm"]));
    assert!(
        refused.stderr.contains("no run has a setting 'sense'; did you mean 'senses'?"),
        "{}",
        refused.stderr
    );
}

#[test]
fn differences_name_the_datasets_that_both_columns_have() {
    let results = without_one_dataset("compare_differences");
    let over = |more: &[&str]| {
        let options =
            ["--where", "scenario=empty", "--models", "network", "--metrics", "r2", "--format", "markdown"];
        let printed = succeed(&results, &[&["compare", "which_sense"], &options[..], more].concat());
        let (_, note) = printed.split_once("95 % interval over ").unwrap();
        note.split(" and ").next().unwrap().trim().to_owned()
    };
    assert_eq!(over(&[]), "3 to 4 datasets");
    assert_eq!(over(&["--against", "arm"]), "3 datasets");
}

#[test]
fn horizons_are_rows_of_one_table() {
    let reference = Path::new(env!("CARGO_MANIFEST_DIR")).join("results/reference");
    let table = |more: &[&str]| {
        let chosen = ["--where", "senses=touch", "--where", "drawn=nothing", "--format", "markdown"];
        let of = ["--metrics", "r2", "--models", "network,persistence"];
        succeed(&reference, &[&["compare", "hidden_stiffness"], &chosen[..], &of, more].concat())
    };
    // In their order, each once.
    let printed = table(&["--horizon", "20,1,5,1", "--of", "contact_force_mean"]);
    let (header, rows) = markdown(&printed);
    assert_eq!(header, ["", "latent 64", "persistence"], "{printed}");
    assert_eq!(rows.iter().map(|row| row[0]).collect::<Vec<_>>(), ["horizon 1", "horizon 5", "horizon 20"]);
    assert!(printed.contains("; horizons in samples of 0.1 s"), "{printed}");
    // Each row is that of the table of its horizon alone, which has more words.
    let alone = table(&["--horizon", "5", "--of", "contact_force_mean"]);
    assert!(markdown(&alone).1[0].ends_with(&rows[1][1..]), "{alone}");
    // Modalities are in the order of the dataset.
    let asked = table(&["--horizon", "1,5", "--of", "contact_force,proprioception"]);
    let names: Vec<&str> = markdown(&asked).1.iter().map(|row| row[1]).collect();
    assert_eq!(names[..2], ["proprioception", "contact force"], "{asked}");
}

#[test]
fn what_does_not_change_in_the_test_samples_is_named() {
    let folder = fresh("compare_no_contact");
    std::fs::create_dir_all(&folder).unwrap();
    let (results, path) = (folder.join("results"), |name: &str| folder.join(name).display().to_string());
    let wall = PENDULUM.lines().find(|line| line.contains("\"wall\"")).unwrap();
    std::fs::write(path("pendulum.xml"), PENDULUM.replace(wall, "")).unwrap();
    succeed(&results, &["world", "new", &path("pendulum.xml")]);
    let checked = plain(&succeed(&results, &["world", "check", &path("pendulum.yaml")]));
    assert!(checked.contains("note: 'contact_force' is 0 in "), "{checked}");
    assert!(!checked.contains("'joints' does not change"), "{checked}");
    let spec = "name: pendulum\nscenarios: [pendulum.yaml]\ninput: [joints]\noutput: [contact_force]\nlatent: 2\n\
                network: {preset: single_to_multi, hidden: [4], memory: gru}\ntasks: [prediction]\n\
                window: {horizon: 4, context: 2}\n\
                simulation: {episodes: 4, actuations_per_episode: 2}\ntraining: {epochs: 1, batch_size: 16}\n";
    std::fs::write(path("spec.yaml"), spec).unwrap();
    let is = "contact_force is 0 in all test samples, so its r2 ";
    let collected = finish(&mut harness(&results, &["collect", &path("spec.yaml")]));
    assert!(collected.code == 0 && plain(&collected.stderr).contains(is), "{}", collected.stderr);
    let moving = ["collect", &path("spec.yaml"), "output=[joints]", "simulation.seed=1"];
    let collected = finish(&mut harness(&results, &moving));
    assert!(collected.code == 0 && !collected.stderr.contains("in all "), "{}", collected.stderr);
    let run = finish(&mut harness(&results, &["run", &path("spec.yaml")]));
    assert!(run.code == 0 && plain(&run.stderr).contains(is), "{}", run.stderr);
    assert!(plain(&run.stdout).contains("so its r2 and wmape are not defined"), "{}", run.stdout);
    let shown = plain(&succeed(&results, &["show", "pendulum", "--all"]));
    let [r2, wmape] =
        ["R2 ↑", "WMAPE (%) ↓"].map(|metric| shown.find(metric).unwrap_or_else(|| panic!("{shown}")));
    assert!(wmape < r2, "{shown}");
    let plot = ["plot", "--x", "latent", "--metrics", "r2", "--output", &path("plot.svg")];
    let refused = plain(&finish(&mut harness(&results, &plot)).stderr);
    assert!(refused.starts_with(&format!("error: {is}is not defined; no run has")), "{refused}");
    let joints = finish(&mut harness(&results, &["compare", "--of", "latent"])).stdout;
    assert!(!joints.contains("contact_force"), "{joints}");
    // The next command works, and shows errors that are defined.
    let (_, next) = run.stdout.split_once("next       harness --results ").unwrap();
    let next: Vec<&str> = next.split_whitespace().skip(1).collect();
    let compared = plain(&succeed(&results, &next));
    assert!(
        compared.contains("RMSE (N)") && compared.contains("so its r2 and wmape are not defined"),
        "{compared}"
    );
    // What is 0 at some horizons may change at others.
    for (option, horizons) in
        [(["--horizon", "4,1"], "horizons 1 and 4"), (["--by", "horizon"], "horizons 1, 2 and 4")]
    {
        let compared = plain(&succeed(&results, &[&["compare"][..], &option].concat()));
        let is = format!(
            "contact_force is 0 in all test samples of {horizons}, so its r2 and wmape are not defined"
        );
        assert!(compared.contains(&is), "{compared}");
    }
    let refused = finish(&mut harness(&results, &["compare", "--metrics", "r2"]));
    assert!(
        refused.code == 2 && refused.stderr.starts_with(&format!("error: {is}is not defined; no run has"))
    );
}

#[test]
fn what_is_chosen_is_what_is_printed() {
    let printed = succeed(
        &RESULTS,
        &["compare", "--models", "network", "--metrics", "relative_error_arm", "--format", "markdown"],
    );
    let (header, rows) = markdown(&printed);
    assert_eq!(header[1..], ["latent 2", "latent 4"]);
    assert_eq!(rows.iter().map(|row| row[0]).collect::<Vec<_>>(), ["empty", "cluttered"]);
    assert!(
        printed.contains("\n\nprediction; smoke; frame difference; relative error arm; mean ± "),
        "{printed}"
    );
    // An experiment's name is escaped for LaTeX.
    let by_name = succeed(&RESULTS, &["compare", "--by", "experiment", "--format", "latex"]);
    assert!(by_name.contains(" & smoke & ") && by_name.contains("SMAPE (\\%)"), "{by_name}");
}

#[test]
fn a_column_has_a_name_where_nothing_varies() {
    for key in ["variant", "settings"] {
        let printed = succeed(&RESULTS, &["compare", "--by", key, "--format", "markdown"]);
        let (header, _) = markdown(&printed);
        let named: Vec<&str> = header.into_iter().skip_while(|title| title.is_empty()).collect();
        assert_eq!(named, ["network", "persistence", "ridge", "training mean"], "{printed}");
    }
}

#[test]
fn a_comparison_of_nothing_is_refused() {
    let nowhere = tempfile::tempdir().unwrap();
    std::fs::create_dir(nowhere.path().join("runs")).unwrap();
    for (results, arguments, expected) in [
        (
            nowhere.path(),
            &["compare"][..],
            "error: there are no finished runs to compare; `harness --results ",
        ),
        (
            &RESULTS,
            &["compare", "smok"],
            "error: 'smok' has no finished runs; did you mean 'smoke'? Those that have: smoke\n",
        ),
        (
            &RESULTS,
            &["compare", SMOKE],
            "error: 'experiments/smoke.yaml' has no finished runs; did you mean 'smoke'? Those that have: smoke\n",
        ),
        (
            &RESULTS,
            &["compare", "--metrics", "r3"],
            "error: there is no metric 'r3'; did you mean 'r2'? the metrics are smape,",
        ),
        (
            &RESULTS,
            &["compare", "--task", "reconstruction", "--metrics", "wmape"],
            "error: no run has these metrics for this task, model, modality and horizon; `harness --results ",
        ),
        (
            &RESULTS,
            &["compare", "--task", "reconstruction", "--metrics", "wmape", "--output", "/dev/null/means.csv"],
            "error: no run has these metrics for this task, model, modality and horizon; `harness --results ",
        ),
        (
            &RESULTS,
            &["compare", "--horizon", "1,", "5"],
            "error: invalid value '' for '--horizon <N>': a list has no spaces and no comma at its end, as in A,B\n",
        ),
        (
            &RESULTS,
            &["compare", "--metrics", "r2,", "rmse"],
            "error: invalid value '' for '--metrics <METRIC>': a list has no spaces and no comma at its end",
        ),
        (&RESULTS, &["compare", "--by", "size"], "error: there is no key 'size'; "),
        (
            &RESULTS,
            &["compare", "--of", "force"],
            "error: no run predicts 'force'; they predict contact_force, frame_difference, proprioception, vision\n",
        ),
    ] {
        let answer = finish(&mut harness(results, arguments));
        assert_eq!((answer.code, answer.stdout.as_str()), (2, ""), "{arguments:?}");
        assert!(answer.stderr.starts_with(expected), "{}", answer.stderr);
    }
}

#[test]
fn numbers_are_sorted_before_texts() {
    let mut values = ["1a", "9", "b", "10", "-2", "1e-3", "12x", "0.5", "a", "none"];
    values.sort_by(|a, b| by_value(a, b));
    assert_eq!(values, ["-2", "1e-3", "0.5", "9", "10", "12x", "1a", "a", "b", "none"]);
}

/// An untrained encoder has the variant of its network, and is not the network.
#[test]
fn an_untrained_encoder_has_a_column_of_its_own() {
    let reference = Path::new(env!("CARGO_MANIFEST_DIR")).join("results/reference");
    let asked =
        ["compare", "probes", "--task", "reconstruction", "--of", "boxes_from_arm", "--metrics", "r2"];
    let compare = |more: &[&str]| succeed(&reference, &[&asked[..], more].concat());
    let mean = |model: &str, senses: &str| {
        let sql = format!(
            "select avg(value) as mean from metrics where experiment = 'probes' and metric = 'r2' and index is null \
             and modality = 'boxes_from_arm' and task = 'reconstruction' and model = '{model}' \
             and variant = 'senses={senses}'"
        );
        ask(&reference, &sql)[0]["mean"].as_f64().unwrap()
    };
    let all = compare(&["--models", "network,untrained"]);
    let line = |text: &str| all.lines().find(|line| line.contains(text)).unwrap();
    let (heading, row) = (line("untrained, "), line("±"));
    let columns: Vec<&str> = heading.split("  ").map(str::trim).filter(|text| !text.is_empty()).collect();
    assert_eq!(columns, ["finger", "touch", "untrained, finger", "untrained, touch"], "{all}");
    for (model, senses) in
        [("network", "finger"), ("network", "touch"), ("untrained", "finger"), ("untrained", "touch")]
    {
        let number = format!("{:.3}", mean(model, senses));
        assert!(row.contains(&number), "{model} {senses}: {number} is not in {row}");
    }
    let network = compare(&["--models", "network"]);
    assert!(!network.contains("untrained"), "{network}");
}
