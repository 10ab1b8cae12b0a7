//! `harness report`: the page is complete, also with missing runs, and safe, also with hostile names.

use crate::common::{MULTI, SINGLE, SMOKE, TINY, finish, fresh, harness, in_chromium, smoke_run, succeed};
use harness::analysis::{LEVEL, mean_interval};
use harness::catalog::query;
use harness::figures::Figure;
use harness::numbers::duration;
use harness::registry::Registry;
use harness::seal::{self, hex};
use harness::tables::{TableFile, write_table};
use polars::prelude::{Column, CsvReader, DataType, IntoColumn, SerReader};
use serde_json::Value;
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::fs;
use std::io::{Read, Write};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

fn folder(name: &str) -> PathBuf {
    let folder = fresh(name);
    fs::create_dir_all(folder.join("runs")).unwrap();
    folder
}

/// Runs of both experiments with two scenarios and two seeds.
static RESULTS: LazyLock<PathBuf> = LazyLock::new(|| {
    let results = folder("report");
    for (spec, more) in
        [(SINGLE, &["latent=[2,4]"][..]), (MULTI, &["latent=[4]", "network.channels=[4]"][..])]
    {
        succeed(&results, &[&["run", spec][..], &TINY, more].concat());
    }
    results
});

/// The page of [`RESULTS`].
static PAGE: LazyLock<String> = LazyLock::new(|| page(&RESULTS, "report.html", &[]));

/// The page that the command writes next to the results.
fn page(results: &Path, name: &str, more: &[&str]) -> String {
    let out = results.join(name);
    let said = succeed(results, &[&["report", "--output", out.to_str().unwrap()][..], more].concat());
    let has_size = [" MB", " kB"].iter().any(|unit| said.trim_end().ends_with(unit));
    assert!(said.contains(name) && has_size, "{said}");
    fs::read_to_string(out).unwrap()
}

/// The page without rendered images, which take most of the time.
fn page_without_pictures(results: &Path, name: &str, more: &[&str]) -> String {
    page_without_driver(results, name, more, Path::new("/dev/null"))
}

/// The page if EGL finds no driver, with a cache folder of images rendered before.
fn page_without_driver(results: &Path, name: &str, more: &[&str], cache: &Path) -> String {
    written_page(results, &results.join(name), more, cache)
}

fn written_page(results: &Path, out: &Path, more: &[&str], cache: &Path) -> String {
    let arguments = [&["report", "--output", out.to_str().unwrap()][..], more].concat();
    let mut command = harness(results, &arguments);
    command.env("__EGL_VENDOR_LIBRARY_FILENAMES", "/nonexistent.json").env("XDG_CACHE_HOME", cache);
    let answer = finish(&mut command);
    assert_eq!(answer.code, 0, "{}", answer.stderr);
    fs::read_to_string(out).unwrap()
}

/// The text between the first occurrence of `before` and the next of `after`.
fn between<'a>(text: &'a str, before: &str, after: &str) -> &'a str {
    let (_, rest) = text.split_once(before).unwrap_or_else(|| panic!("there is no {before}"));
    rest.split_once(after).unwrap_or_else(|| panic!("there is no {after}")).0
}

/// The JSON data that the page's script draws.
pub fn data(page: &str) -> Value {
    serde_json::from_str(between(page, "<script type=\"application/json\" id=\"data\">", "</script>"))
        .unwrap()
}

const PUBLISHED: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/results/reference");

/// The page of all published results.
static PUBLISHED_PAGE: LazyLock<String> = LazyLock::new(|| {
    let out = folder("report_reference").join("report.html");
    succeed(Path::new(PUBLISHED), &["report", "--output", out.to_str().unwrap()]);
    fs::read_to_string(out).unwrap()
});

/// The published runs of reproduction.yaml judge the claims.
#[test]
fn verdicts_of_readings_are_below_each_claim() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("page.html");
    let one = written_page(Path::new(PUBLISHED), &out, &["which_sense"], Path::new("/dev/null"));
    assert!(!one.contains("class=\"reading\""), "a page of chosen experiments is about these");
    let claim = between(&PUBLISHED_PAGE, "id=\"claim-force_errors_stay_high\"", "</details>");
    // No run is of the claims' own experiments, so that the line names the scenario.
    let reading = ", recommended, 4 datasets</span>";
    assert_eq!(claim.matches(reading).count(), 2, "{claim}");
    let below = claim.split(reading).nth(1).unwrap();
    assert!(below.contains("<span class=\"verdict "), "{below}");
}

#[test]
fn every_section_is_there() {
    for section in ["scenes", "claims", "joints", "regression", "figures", "training", "runs"] {
        let part = between(&PAGE, &format!("<section id=\"{section}\">"), "</section>");
        assert!(part.contains("<h2>"), "{section}");
        assert!(!part.contains("class=\"absent\""), "{section} lacks something:\n{part}");
        assert!(PAGE.contains(&format!("<a href=\"#{section}\">")), "{section}");
    }
    for figure in Figure::OF_THE_PAPER {
        let drawn = between(&PAGE, &format!("<figure id=\"figure-{}\">", figure.name()), "</figure>");
        assert!(drawn.contains("<svg ") && drawn.contains(figure.meaning()), "{}", figure.name());
    }
    let claims = harness::claims::load(Path::new("experiments/claims.yaml")).unwrap().claims;
    for claim in &claims {
        let shown = between(&PAGE, &format!("id=\"claim-{}\"", claim.id()), "</details>");
        let query = between(shown, "<pre tabindex=\"0\" aria-label=\"Query\">", "</pre>");
        assert_eq!(unescaped(query), claim.sql(false), "{}", claim.id());
        if let Some(required) = claim.required_sql(false) {
            let query =
                between(shown, "<pre tabindex=\"0\" aria-label=\"Query of what is required\">", "</pre>");
            assert_eq!(unescaped(query), required, "{}", claim.id());
        }
    }
    // One experiment has 2 latent sizes and the other 1, each with 2 scenarios and 2 seeds.
    assert_eq!(PAGE.matches("<details class=\"run\">").count(), (2 + 1) * 2 * 2);
    for record in Registry::new(&*RESULTS).records() {
        for text in [&record.run, &record.spec_hash, &record.dataset, &record.provenance.host] {
            assert!(PAGE.contains(&escaped(text)), "{text}");
        }
        if let Some(commit) = &record.provenance.git_commit {
            assert!(PAGE.contains(commit.as_str()));
        }
    }
}

/// The characters that minijinja escapes.
const ESCAPES: [(&str, &str); 6] =
    [("&", "&amp;"), ("<", "&lt;"), (">", "&gt;"), ("\"", "&quot;"), ("'", "&#x27;"), ("/", "&#x2f;")];

fn escaped(text: &str) -> String {
    ESCAPES.iter().fold(text.to_owned(), |text, (sign, name)| text.replace(sign, name))
}

fn code(text: &str) -> String {
    format!("<code>{}</code>", escaped(text))
}

fn unescaped(text: &str) -> String {
    ESCAPES.iter().rev().fold(text.to_owned(), |text, (sign, name)| text.replace(name, sign))
}

#[test]
fn verdicts_are_those_of_harness_claims() {
    let table = succeed(&RESULTS, &["claims"]);
    let summary = table.lines().find(|line| line.contains(" hold, ")).unwrap();
    let numbers = summary.split(';').next().unwrap().split(|c: char| !c.is_ascii_digit());
    let counts: Vec<usize> = numbers.filter_map(|word| word.parse().ok()).collect();
    assert_eq!(counts.len(), 5, "{summary}");
    for (class, count) in ["holds", "fails", "undecided", "untestable", "missing"].iter().zip(counts) {
        let shown = between(&PAGE, &format!("<div class=\"{class}\">"), "</div>");
        assert_eq!(between(shown, "<dd>", "</dd>"), count.to_string(), "{class}: {summary}");
        assert_eq!(PAGE.matches(&format!("<span class=\"verdict {class}\">")).count(), count);
    }
}

#[test]
fn corrected_p_values_stand_beside_the_verdicts() {
    let csv = RESULTS.join("verdicts.csv");
    succeed(&RESULTS, &["claims", "--output", csv.to_str().unwrap()]);
    let table = CsvReader::new(fs::File::open(csv).unwrap()).finish().unwrap();
    let (p, verdicts) = (table.column("p_holm").unwrap(), table.column("verdict").unwrap());
    let part = between(&PAGE, "<section id=\"claims\">", "</section>");
    let shown: Vec<&str> =
        part.split("<span class=\"p\">").skip(1).map(|rest| rest.split('<').next().unwrap()).collect();
    let marks: Vec<bool> = part
        .split("<span class=\"verdict ")
        .skip(1)
        .map(|rest| rest.split("</span>").next().unwrap().ends_with(" *"))
        .collect();
    assert_eq!((shown.len(), marks.len()), (table.height(), table.height()));
    let mut tested = 0;
    for row in 0..table.height() {
        let p = p.get(row).unwrap();
        let expected = if p.is_null() { None } else { Some(p.try_extract::<f64>().unwrap()) };
        let words = expected.map(|p| if p < 0.001 { "p < 0.001".into() } else { format!("p = {p:.3}") });
        assert_eq!(unescaped(shown[row]), words.unwrap_or_default());
        let verdict = verdicts.get(row).unwrap().str_value().into_owned();
        let decided = ["holds", "does not hold"].contains(&verdict.as_str());
        assert_eq!(marks[row], decided && expected.is_some_and(|p| p >= 0.05), "{verdict} {expected:?}");
        tested += usize::from(expected.is_some());
    }
    assert!(tested > 3, "{tested}");
}

#[test]
fn numbers_to_look_closer_at_are_those_of_a_query() {
    let data = data(&PAGE);
    let registry = Registry::new(&*RESULTS);
    let text = |row: &Value, key: &str| row[key].as_str().unwrap().to_owned();
    let joints = data["joints"].as_array().unwrap();
    let networks = joints.iter().filter(|row| row["model"] == "network");
    let mut checked = 0;
    for row in networks.step_by(7) {
        let sql = format!(
            "select \"index\", value from metrics where experiment = '{}' and scenario = '{}' and latent = {} and \
             task = '{}' and modality = '{}' and metric = '{}' and model = 'network' and \"index\" = 17",
            text(row, "study"),
            text(row, "scenario"),
            row["latent"],
            text(row, "task"),
            text(row, "modality"),
            text(row, "metric"),
        );
        let found = query(&registry, &sql).unwrap();
        let values: Vec<f64> = found.column("value").unwrap().f64().unwrap().iter().flatten().collect();
        match mean_interval(&values, LEVEL) {
            None => assert!(row["values"][17].is_null(), "{sql}"),
            Some(interval) => {
                let bounds = interval.bounds.into_iter().flat_map(|(low, high)| [low, high]);
                let expected: Vec<f64> = std::iter::once(interval.mean).chain(bounds).collect();
                let shown: Vec<f64> = serde_json::from_value(row["values"][17].clone()).unwrap();
                assert_eq!(shown.len(), expected.len(), "{sql}");
                for (shown, expected) in shown.iter().zip(&expected) {
                    assert!((shown - expected).abs() <= 1e-4 * expected.abs(), "{sql}: {shown} {expected}");
                }
                checked += 1;
            }
        }
    }
    assert!(checked > 5, "only {checked} values were compared");

    let clouds = data["regression"].as_array().unwrap();
    // Two modalities, two fingertips, two scenarios, and three latent sizes of both experiments.
    assert_eq!(clouds.len(), 2 * 2 * 2 * 3);
    for cloud in clouds {
        // The test episode has 29 transitions.
        assert_eq!(cloud["points"].as_array().unwrap().len(), 29);
    }
    // Each run has two tasks. Each term has two epochs of two splits.
    let training = data["training"].as_array().unwrap();
    assert_eq!(training.len(), 12 * 2);
    for curves in training {
        assert_eq!(curves["epochs"], serde_json::json!([1, 2]));
        for split in ["train", "validation"] {
            assert_eq!(curves["terms"]["total"][split].as_array().unwrap().len(), 2);
        }
    }
}

#[test]
fn the_page_of_the_published_results_is_small() {
    let page = &*PUBLISHED_PAGE;
    assert!(page.len() < 6_100_000, "{} bytes", page.len());
    let answer = query(
        &Registry::new(PUBLISHED),
        "select experiment, run, task, max(epoch) as last from epochs where variant not like 'reading=%' \
         group by experiment, run, task",
    );
    let answer = answer.unwrap();
    let column = |name: &str| answer.column(name).unwrap().clone();
    let (experiments, runs, tasks, last) =
        (column("experiment"), column("run"), column("task"), column("last"));
    let data = data(page);
    for row in 0..answer.height() {
        let text = |column: &Column| column.get(row).unwrap().str_value().into_owned();
        let last = last.get(row).unwrap().try_extract::<u64>().unwrap();
        let curves = data["training"].as_array().unwrap().iter().find(|curves| {
            curves["experiment"] == text(&experiments)
                && curves["run"] == text(&runs)
                && curves["task"] == text(&tasks)
        });
        let epochs: Vec<u64> = serde_json::from_value(curves.unwrap()["epochs"].clone()).unwrap();
        assert_eq!((epochs.first(), epochs.last()), (Some(&1), Some(&last)));
        assert!(
            (last.min(50)..=last.min(100)).contains(&(epochs.len() as u64)),
            "{} of {last}",
            epochs.len()
        );
        assert!(epochs.is_sorted_by(|a, b| a < b));
    }
}

/// The curves have the first and the last epoch.
#[test]
fn long_trainings_are_drawn_with_fewer_epochs() {
    let results = folder("report_long");
    let vectors =
        ["scenarios=[empty]", "latent=[2]", "seeds=[0]", "tasks=[prediction]", "training.patience=null"];
    succeed(&results, &[&["run", SINGLE][..], &TINY, &vectors, &["training.epochs=150"]].concat());
    let data = data(&page_without_pictures(&results, "report.html", &[]));
    let epochs: Vec<u64> = serde_json::from_value(data["training"][0]["epochs"].clone()).unwrap();
    assert_eq!((epochs.first(), epochs.last()), (Some(&1), Some(&150)));
    assert!((50..=100).contains(&epochs.len()) && epochs.is_sorted_by(|a, b| a < b), "{epochs:?}");
}

/// Two seeds on each of two datasets are two values, not four.
#[test]
fn intervals_of_joints_are_over_datasets() {
    let results = folder("report_datasets");
    let settings = ["latent=[2]", "scenarios=[cluttered]", "vary={simulation.seed: [0, 1]}"];
    succeed(&results, &[&["run", SINGLE][..], &TINY, &settings].concat());
    let data = data(&page_without_pictures(&results, "report.html", &[]));
    let sql = "select dataset_seed, index, model, value from metrics join runs \
               using (experiment, run, scenario, latent) where task = 'prediction' and modality = 'proprioception' \
               and metric = 'rmse' and index = 17";
    let found = query(&Registry::new(&results), sql).unwrap();
    let column = |name: &str| found.column(name).unwrap().cast(&DataType::Float64).unwrap();
    let (seeds, values) = (column("dataset_seed"), column("value"));
    let (seeds, values) = (seeds.f64().unwrap(), values.f64().unwrap());
    let models = found.column("model").unwrap().str().unwrap();
    for (model, rows) in [("network", 4), ("persistence", 4)] {
        let of = |seed: f64| -> Vec<f64> {
            let is_of = |row: &usize| models.get(*row) == Some(model) && seeds.get(*row) == Some(seed);
            (0..found.height()).filter(is_of).filter_map(|row| values.get(row)).collect()
        };
        assert_eq!(of(0.0).len() + of(1.0).len(), rows);
        let means = [of(0.0), of(1.0)].map(|values| values.iter().sum::<f64>() / values.len() as f64);
        let expected = mean_interval(&means, LEVEL).unwrap();
        let is_shown = |row: &&Value| {
            let has = |key: &str, value: &str| row[key] == value;
            has("task", "prediction")
                && has("modality", "proprioception")
                && has("metric", "rmse")
                && has("model", model)
        };
        let shown = data["joints"].as_array().unwrap().iter().find(is_shown).unwrap();
        assert_eq!(shown["over"], "2 datasets");
        let (low, high) = expected.bounds.unwrap();
        let shown: Vec<f64> = serde_json::from_value(shown["values"][17].clone()).unwrap();
        for (shown, expected) in shown.iter().zip([expected.mean, low, high]) {
            assert!((shown - expected).abs() <= 1e-4 * expected.abs(), "{model}: {shown} {expected}");
        }
    }
}

#[test]
fn times_are_what_a_person_would_say() {
    let said = [0.04, 9.94, 31.8, 119.4, 120.0, 2640.0, 7199.0, 7200.0, 18_720.0].map(duration);
    assert_eq!(said, ["0.0 s", "9.9 s", "32 s", "119 s", "2 min", "44 min", "120 min", "2.0 h", "5.2 h"]);
}

#[test]
fn same_tables_give_same_bytes_with_new_or_earlier_pictures() {
    let caches = folder("report_caches");
    let cache = caches.join("harness");
    let names = || -> Vec<String> {
        let entries = fs::read_dir(&cache).unwrap().flatten();
        let mut names: Vec<_> = entries.map(|entry| entry.file_name().into_string().unwrap()).collect();
        names.sort();
        names
    };
    fs::create_dir(&cache).unwrap();
    fs::write(cache.join("task-0123456789abcdef"), "another program's").unwrap();
    let out = RESULTS.join("anew.html");
    let mut anew = harness(&RESULTS, &["report", "--threads", "1", "--output", out.to_str().unwrap()]);
    assert_eq!(finish(anew.env("XDG_CACHE_HOME", &caches)).code, 0);
    assert!(*PAGE == fs::read_to_string(out).unwrap());
    let kept = names();
    let expected = ["clip-cluttered-", "clip-empty-", "sim_env-", "task-"];
    assert!(
        kept.len() == 4 && kept.iter().zip(expected).all(|(name, begin)| name.starts_with(begin)),
        "{kept:?}"
    );

    // An image in another format is rendered again. The clip of the empty scene is the fastest to render.
    let format = |path: &Path| {
        let bytes = fs::read(path).unwrap();
        serde_json::from_slice::<Value>(&bytes[..bytes.len() - seal::BLANK.len()]).is_ok()
    };
    let clip = cache.join(&kept[1]);
    seal::write(&clip, [b"not JSON", seal::BLANK.as_bytes()].concat()).unwrap();
    assert!(!format(&clip));
    let out = RESULTS.join("again.html");
    let mut again = harness(&RESULTS, &["report", "--output", out.to_str().unwrap()]);
    let answer = finish(again.env("XDG_CACHE_HOME", &caches));
    assert_eq!(answer.code, 0, "{}", answer.stderr);
    assert!(*PAGE == fs::read_to_string(out).unwrap());
    assert!(format(&clip));

    // Without a driver nothing can be rendered, so all images are from the cache. A damaged one is not used.
    assert!(*PAGE == page_without_driver(&RESULTS, "before.html", &[], &caches));
    let mut damaged = fs::read(cache.join(&kept[3])).unwrap();
    let middle = damaged.len() / 2;
    damaged[middle] ^= 1;
    fs::write(cache.join(&kept[3]), damaged).unwrap();
    let page = page_without_driver(&RESULTS, "damaged.html", &[], &caches);
    let task = between(&page, "<figure id=\"figure-task\">", "</figure>");
    assert!(task.contains("It could not be rendered"), "{task}");
}

#[test]
fn nothing_is_loaded_from_outside() {
    let places = |text: &str, before: &str| -> Vec<String> {
        text.match_indices(before)
            .map(|(at, _)| text[at + before.len()..].chars().take(40).collect())
            .collect()
    };
    for before in [" src=\"", " href=\"", " srcset=\"", " data=\"", " action=\"", " poster=\"", "url("] {
        for place in places(&PAGE, before) {
            assert!(place.starts_with("data:") || place.starts_with('#'), "{before}{place}");
        }
    }
    assert!(!PAGE.contains("@import") && !PAGE.contains("<link") && !PAGE.contains("<iframe"));
    let policy = between(&PAGE, "http-equiv=\"Content-Security-Policy\" content=\"", "\"");
    assert!(
        unescaped(policy).starts_with("default-src 'none'; img-src data:; style-src 'sha256-"),
        "{policy}"
    );
    assert!(!policy.contains("unsafe"), "{policy}");
}

#[test]
fn the_license_of_the_bundled_charts_goes_with_the_page() {
    for text in ["uPlot (v1.6.32)", "Copyright (c) 2022 Leon Sorokin", "Permission is hereby granted"] {
        assert!(PAGE.contains(text), "{text}");
    }
}

#[test]
fn without_runs_the_page_names_the_commands_that_make_them() {
    let results = folder("report_empty");
    let empty = page(&results, "report.html", &[]);
    let command = |arguments: &str| code(&format!("harness --results {} run {arguments}", results.display()));
    for study in ["single_to_multi", "multi_to_multi"] {
        assert!(empty.contains(&command(study)), "{study}");
    }
    // The scenes and the two figures that show them need no runs.
    assert_eq!(empty.matches("<figure class=\"clip\"").count(), 2);
    for (figure, drawn) in [(Figure::Task, true), (Figure::SimEnv, true), (Figure::Regression, false)] {
        let part = between(&empty, &format!("<figure id=\"figure-{}\">", figure.name()), "</figure>");
        assert_eq!(part.contains("<svg "), drawn, "{}", figure.name());
    }
    for section in ["joints", "regression", "training", "runs"] {
        let part = between(&empty, &format!("<section id=\"{section}\">"), "</section>");
        assert!(part.contains("class=\"absent\"") && part.contains("<code>harness --results "), "{section}");
    }
    assert_eq!(data(&empty)["joints"], serde_json::json!([]));

    let quick = page_without_pictures(&results, "quick.html", &["--quick"]);
    assert!(quick.contains(&command("multi_to_multi --quick")));
    assert!(!quick.contains(&command("multi_to_multi")));
}

#[test]
fn one_study_alone_is_shown_and_the_other_named() {
    let results = folder("report_single");
    let arguments =
        [&["run", SINGLE][..], &TINY, &["latent=[2]", "scenarios=[cluttered]", "seeds=[0]"]].concat();
    succeed(&results, &arguments);
    let page = page_without_pictures(&results, "report.html", &[]);
    for section in ["joints", "regression"] {
        let part = between(&page, &format!("<section id=\"{section}\">"), "</section>");
        assert!(part.contains("There is no finished run of multi_to_multi."), "{part}");
        assert!(part.contains(&format!("id=\"{section}-chart\"")), "{part}");
        assert!(data(&page)[section].as_array().unwrap().iter().all(|row| row["study"] == "single_to_multi"));
    }
}

/// The experiments in a part of the page's data.
fn experiments_in(data: &Value, part: &str, key: &str) -> BTreeSet<String> {
    data[part].as_array().unwrap().iter().map(|row| row[key].as_str().unwrap().to_owned()).collect()
}

#[test]
fn a_report_of_an_experiment_has_only_its_results() {
    let page = page_without_pictures(&RESULTS, "one.html", &["multi_to_multi"]);
    assert_eq!(between(&page, "<h1>", "</h1>"), "multi_to_multi");
    let twice = page_without_pictures(&RESULTS, "twice.html", &["multi_to_multi", "multi_to_multi"]);
    assert!(page == twice, "a repeated name changes nothing");
    let (own, all) = (data(&page), data(&PAGE));
    for (part, key) in [("joints", "study"), ("regression", "study"), ("training", "experiment")] {
        assert_eq!(experiments_in(&own, part, key), BTreeSet::from(["multi_to_multi".to_owned()]), "{part}");
    }
    // The numbers are those of the page of all results.
    let curves = |data: &Value| -> Vec<Value> {
        let rows = data["training"].as_array().unwrap().iter();
        rows.filter(|row| row["experiment"] == "multi_to_multi").cloned().collect()
    };
    assert_eq!(curves(&own), curves(&all));
    let values = |data: &Value| -> Vec<Value> {
        let rows = data["joints"].as_array().unwrap().iter();
        rows.filter(|row| row["study"] == "multi_to_multi").map(|row| row["values"].clone()).collect()
    };
    assert_eq!(values(&own), values(&all));
    // One latent size, two scenarios and two seeds.
    assert_eq!(page.matches("<details class=\"run\">").count(), 4);
    let claims = harness::claims::load(Path::new("experiments/claims.yaml")).unwrap().claims;
    let decided = claims.iter().filter(|claim| claim.experiments(false) == ["multi_to_multi"]);
    let decided: BTreeSet<&str> = decided.map(|claim| claim.id()).collect();
    let shown: BTreeSet<&str> =
        page.split("id=\"claim-").skip(1).map(|rest| rest.split('"').next().unwrap()).collect();
    assert!(shown == decided && !shown.is_empty(), "{shown:?} {decided:?}");
    // Figures that compare it with another experiment are left out, and nothing says that others have no runs.
    assert!(page.contains("id=\"figure-forces_dataset\"") && !page.contains("id=\"figure-regression\""));
    assert!(!page.contains("There is no finished run"), "{page}");
    for link in page.split("<a href=\"#").skip(1).map(|rest| rest.split('"').next().unwrap()) {
        assert!(page.contains(&format!("id=\"{link}\"")), "{link}");
    }

    let names = ["single_to_multi", "multi_to_multi"];
    let both = page_without_pictures(&RESULTS, "both.html", &names);
    assert_eq!(experiments_in(&data(&both), "joints", "study").len(), 2);
    let is_decided = |claim: &&harness::claims::Claim| {
        claim.experiments(false).iter().all(|name| names.contains(&name.as_str()))
    };
    let decided = claims.iter().filter(is_decided).count();
    assert_eq!(both.matches("<details class=\"claim\"").count(), decided);
}

#[test]
fn an_experiment_with_other_inputs_is_no_study_in_figures() {
    let folder = folder("report_inputs");
    let figures = |experiments: &[&str]| {
        let out = folder.join("report.html");
        let arguments = [&["report", "--out", out.to_str().unwrap()][..], experiments].concat();
        let mut command = harness(&folder, &arguments);
        command.env("__EGL_VENDOR_LIBRARY_FILENAMES", "/nonexistent.json").env("XDG_CACHE_HOME", "/dev/null");
        let answer = finish(&mut command);
        assert_eq!(answer.code, 0, "{}", answer.stderr);
        between(&fs::read_to_string(out).unwrap(), "<section id=\"figures\">", "</section>").to_owned()
    };
    let few = ["latent=[4]", "seeds=[0]"];
    for (path, name) in [(SINGLE, "single_to_multi"), (MULTI, "multi_to_multi"), (MULTI, "same_input")] {
        succeed(&folder, &[&["run", path][..], &TINY, &few, &[&format!("name={name}")]].concat());
    }
    succeed(&folder, &[&["run", SINGLE][..], &TINY, &few, &["name=senses", "input=[arm]"]].concat());
    // The networks of senses have other inputs than those of multi_to_multi.
    let without_multi = figures(&["single_to_multi", "senses"]);
    assert!(without_multi.contains("id=\"figure-forces_dataset\""));
    assert!(!without_multi.contains("id=\"figure-prediction_results\""));
    // A study's own experiment is drawn, not another one with the same inputs.
    let studies = figures(&["single_to_multi", "multi_to_multi"]);
    assert!(studies.contains("id=\"figure-prediction_results\""));
    let experiments = ["senses", "same_input", "multi_to_multi", "single_to_multi"];
    assert!(figures(&experiments) == studies);
}

#[test]
fn a_report_of_an_unknown_experiment_only_says_which_there_are() {
    let out = RESULTS.join("unknown.html");
    let arguments = ["report", "multi_to_mlti", "--output", out.to_str().unwrap()];
    let answer = finish(&mut harness(&RESULTS, &arguments));
    let expected = "error: 'multi_to_mlti' has no finished runs; did you mean 'multi_to_multi'? Those that have: \
                    multi_to_multi, single_to_multi\n";
    assert_eq!((answer.stdout.as_str(), answer.stderr.as_str()), ("", expected));
    assert!(answer.code != 0 && !out.exists());
}

#[test]
fn a_report_of_another_world_has_what_there_is() {
    let results = folder("report_tendon");
    let settings = ["scenarios=[tendon]", "seeds=[0]", "tasks=[prediction]"];
    succeed(&results, &[&["run", SMOKE][..], &settings].concat());
    let page = page_without_pictures(&results, "report.html", &["smoke"]);
    // There are no claims and figures about this world. Without an OpenGL driver, the scene says why it is missing.
    let expected =
        ["metrics", "joints", "regression", "course", "images", "scenes", "training", "modalities", "runs"];
    assert_eq!(sections(&page), expected);
    assert_eq!(experiments_in(&data(&page), "training", "experiment"), BTreeSet::from(["smoke".to_owned()]));
}

fn sections(page: &str) -> Vec<&str> {
    page.split("<section id=\"").skip(1).map(|rest| rest.split('"').next().unwrap()).collect()
}

/// A cart with a pendulum. Its joints have two units, so they are judged by unit.
pub const PENDULUM: &str = r#"<mujoco><option timestep="0.005"/>
  <visual><quality shadowsize="0" offsamples="0"/></visual><worldbody>
  <light pos="0 -1 2"/><geom name="floor" type="plane" size="2 2 .1" rgba=".8 .8 .7 1"/>
  <geom name="wall" type="box" pos=".15 0 .35" size=".02 .2 .35" rgba=".3 .4 .7 1"/>
  <camera name="side" pos="0 -1.6 .7" xyaxes="1 0 0 0 0 1"/>
  <body name="cart" pos="0 0 .8"><joint name="slide" type="slide" axis="1 0 0" range="-.5 .5" damping="2"/>
    <geom name="cart" type="box" size=".06 .05 .03" mass="1"/>
    <body name="rod"><joint name="swing" axis="0 1 0" damping=".02"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass=".2" rgba=".8 .4 .2 1"/></body></body>
  </worldbody><actuator><position name="push" joint="slide" kp="200" ctrlrange="-.4 .4"/></actuator></mujoco>"#;

/// Runs in a world with a pendulum, and the page of all results. `settings` are those of the spec that differ.
fn pendulum_page(name: &str, settings: &str) -> (PathBuf, String) {
    let results = folder(&format!("report_{name}"));
    let path = |name: &str| results.join(name).display().to_string();
    fs::write(path("pendulum.xml"), PENDULUM).unwrap();
    succeed(&results, &["world", "new", &path("pendulum.xml")]);
    let spec = format!(
        "name: {name}\nscenarios: [pendulum.yaml]\ninput: [joints, side]\n\
         output: [joints, contact_force, side_difference]\nseeds: [0, 1]\n{settings}\n\
         network: {{preset: multi_to_multi, hidden: [8], channels: [2]}}\n\
         simulation: {{episodes: 4, actuations_per_episode: 2}}\ntasks: [prediction]\n\
         training: {{epochs: 2, batch_size: 16}}\n"
    );
    fs::write(path("spec.yaml"), spec).unwrap();
    succeed(&results, &["run", &path("spec.yaml")]);
    let page = page(&results, "report.html", &[]);
    (results, page)
}

/// Runs in a world with a pendulum, and the page of all results.
pub static PENDULUM_PAGE: LazyLock<(PathBuf, String)> =
    LazyLock::new(|| pendulum_page("pendulum", "latent: [2, 4]"));

/// Runs of three inputs in the world with a pendulum, and the page of all results.
pub static ABLATION_PAGE: LazyLock<(PathBuf, String)> = LazyLock::new(|| {
    pendulum_page("ablation", "latent: 2\nvary: {input: [[joints], [joints, side], [side]]}")
});

/// Runs of the rope of docs/which-sense-matters.md with little data, and the page of all results.
pub static ROPE_PAGE: LazyLock<(PathBuf, String)> = LazyLock::new(|| {
    let results = folder("report_rope");
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/which-sense-matters.md");
    let text = fs::read_to_string(page).unwrap();
    for block in text.split("<!-- file: ").skip(1) {
        let (name, rest) = block.split_once(" -->").unwrap();
        let content = between(rest, "\n```", "\n```").split_once('\n').unwrap().1;
        let path = results.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, content).unwrap();
    }
    let spec = results.join("rope/senses.yaml");
    let little = ["simulation.episodes=6", "training.epochs=2", "seeds=[0,1]"];
    succeed(&results, &[&["run", spec.to_str().unwrap()][..], &little].concat());
    let page = self::page(&results, "report.html", &[]);
    (results, page)
});

/// The inputs of [`ABLATION_PAGE`] in the order of the spec, as variants and as their short names.
const INPUTS: [(&str, &str); 3] =
    [("input=joints", "joints"), ("input=joints+side", "joints + side"), ("input=side", "side")];

#[test]
fn an_ablation_has_one_table_of_metrics_as_compare() {
    let (results, page) = &*ABLATION_PAGE;
    assert!(!between(page, "<main>", "</main>").contains("class=\"absent\""), "nothing is missing");
    assert_eq!(page.matches("<table class=\"facts numbers\">").count(), 2);
    let (table, baselines) = between(page, "<section id=\"metrics\">", "</section>")
        .split_once("<details><summary>Other baselines</summary>")
        .unwrap();
    let columns = |table: &'static str| -> Vec<&str> {
        let columns = between(table, "<th scope=\"col\">metric</th>", "</tr>").split("<th scope=\"col\">");
        columns.skip(1).map(|column| column.strip_suffix("</th>").unwrap()).collect()
    };
    // Persistence and the training mean need no input, and ridge regression has another one for each input.
    let expected = INPUTS.map(|(_, name)| name).into_iter().chain(["persistence"]);
    assert_eq!(columns(table), expected.collect::<Vec<_>>());
    let baselines = columns(baselines);
    let ridge: BTreeSet<&str> = baselines.iter().filter_map(|name| name.strip_prefix("ridge, ")).collect();
    assert_eq!(ridge, INPUTS.map(|(_, name)| name).into());
    assert_eq!((baselines.len(), baselines.last()), (4, Some(&"training mean")));

    let file = results.join("means.json");
    let metrics = ["compare", "ablation", "--metrics", "r2,rmse,mae,relative_error"];
    succeed(results, &[&metrics[..], &["--output", file.to_str().unwrap()]].concat());
    let means: Vec<Value> = serde_json::from_slice(&fs::read(file).unwrap()).unwrap();
    let mut compared = 0;
    for mean in means.iter().filter(|mean| mean["model"] == "network") {
        let text = |key: &str| mean[key].as_str().unwrap_or_default();
        let modality = format!("{} {}", text("modality").replace('_', " "), text("direction"));
        let label = harness::metrics::label(text("metric"), text("unit"));
        let row = format!("<th scope=\"row\">{}</th><td>{} ", modality.trim_end(), escaped(&label));
        let cells: Vec<String> = between(table, &row, "</tr>")
            .split("<td>")
            .skip(1)
            .map(|cell| cell.replace("<b>", "").replace("</b>", ""))
            .collect();
        let column = INPUTS.iter().position(|(variant, _)| *variant == text("variant")).unwrap();
        let value = harness::metrics::rounded(mean["mean"].as_f64().unwrap(), text("unit"));
        assert!(cells[column].starts_with(&value), "{mean}: {cells:?}");
        compared += 1;
    }
    // Three metrics of the joints in each of two units, of the forces and of the image, for three inputs. Of forces
    // that are all zero, no R2 is defined.
    assert!(compared >= 3 * (3 * 2 + 2 + 3), "{compared}");
}

#[test]
fn each_variant_of_an_ablation_has_charts_and_images() {
    let (_, page) = &*ABLATION_PAGE;
    let data = data(page);
    let names: BTreeSet<String> = INPUTS.map(|(_, name)| name.to_owned()).into();
    for part in ["joints", "regression", "course"] {
        assert_eq!(experiments_in(&data, part, "input"), names, "{part}");
        assert_eq!(experiments_in(&data, part, "study").len(), names.len(), "{part}");
    }
    let images = between(page, "<section id=\"images\">", "</section>");
    for name in &names {
        assert!(images.contains(&format!("<span class=\"aside\">{name}, pendulum, prediction")), "{images}");
    }
}

#[test]
fn a_page_shows_six_variants_and_says_how_many_there_are() {
    let (results, _) = &*ABLATION_PAGE;
    let copy = folder("report_variants");
    let path = |name: &str| results.join(name).display().to_string();
    let vary = "vary={network.hidden: [[2], [3], [4], [5], [6], [7], [8]]}";
    succeed(&copy, &["run", &path("spec.yaml"), "name=many", vary, "seeds=[0]"]);
    let page = page_without_pictures(&copy, "report.html", &["many"]);
    let header = unescaped(between(&page, "<header>", "</header>"));
    let said = "Charts and images show the first 6 of the 7 variants of many; `--where 'variant=…'` chooses others, \
                and the tables of metrics have all.";
    assert!(header.contains(said), "{header}");
    assert_eq!(experiments_in(&data(&page), "joints", "input").len(), 6);
    assert!(page.contains("<th scope=\"col\">hidden=8</th>"));
    let chosen = page_without_pictures(&copy, "chosen.html", &["many", "--where", "variant=hidden=8"]);
    assert!(!chosen.contains("Charts and images show"));
    assert_eq!(experiments_in(&data(&chosen), "joints", "input"), ["from joints + side".to_owned()].into());
}

#[test]
fn a_page_about_another_robot_has_every_part_and_no_finger() {
    let (results, page) = &*PENDULUM_PAGE;
    let expected =
        ["metrics", "joints", "regression", "course", "images", "scenes", "training", "modalities", "runs"];
    assert_eq!(sections(page), expected);
    let (text, script) = page.split_once("<script type").unwrap();
    let said = text.split_once("</style>").unwrap().1.to_lowercase();
    for word in ["finger", "flexion", "paper", "claim"] {
        assert!(!said.contains(word), "{word}: {said}");
    }
    let parts = between(&said, "<main>", "</main>");
    assert!(!parts.contains("class=\"absent\""), "{parts}");
    assert!(!script.split("</script>").next().unwrap().contains("finger"));
    assert_eq!(between(page, "<h1>", "</h1>"), "pendulum");
    // The picture of the world, and what each sample records.
    assert_eq!(page.matches("<figure class=\"clip\"").count(), 1);
    assert_eq!(data(page)["clips"][0]["frames"].as_array().unwrap().len(), 20, "two seconds at 10 Hz");
    let modalities = between(page, "<section id=\"modalities\">", "</section>");
    for row in [
        "<th scope=\"row\">joints</th><td>2 values</td><td class=\"elements\">slide in m; swing in rad</td>\
         <td>input, output</td>",
        "<th scope=\"row\">side</th><td>image of 64 × 64 pixels</td>",
        "<th scope=\"row\">setpoint</th><td>1 value</td><td class=\"elements\">push</td><td>action</td>",
    ] {
        assert!(modalities.contains(row), "{row}: {modalities}");
    }
    // Named or not, the page is the same.
    assert!(*page == self::page(results, "named.html", &["pendulum"]));
}

#[test]
fn the_tables_and_courses_of_any_robot_are_those_of_queries() {
    let (results, page) = &*PENDULUM_PAGE;
    let registry = Registry::new(results);
    let value = |sql: &str| -> Vec<f64> {
        let found = query(&registry, sql).unwrap();
        let column = found.columns().last().unwrap().cast(&DataType::Float64).unwrap();
        column.f64().unwrap().iter().flatten().collect()
    };
    let rows = between(page, "<section id=\"metrics\">", "</section>");
    assert!(rows.contains("<th scope=\"col\">latent 2</th><th scope=\"col\">latent 4</th>"), "{rows}");
    for baseline in ["persistence", "ridge", "training mean"] {
        assert!(rows.contains(&format!("<th scope=\"col\">{baseline}</th>")), "{baseline}");
    }
    let row = between(rows, "<th scope=\"row\">joints in rad</th><td>R2 ↑</td>", "</tr>");
    let cells: Vec<String> =
        row.split("<td>").skip(1).map(|cell| cell.replace("<b>", "").replace("</b>", "")).collect();
    let of = |model: &str, latent: u32| {
        let sql = format!(
            "select value from metrics where modality = 'joints' and direction = 'in rad' and metric = 'r2' \
             and index is null and model = '{model}' and latent = {latent} order by seed"
        );
        let values = value(&sql);
        assert_eq!(values.len(), 2, "{sql}");
        values.iter().sum::<f64>() / 2.0
    };
    // The columns of the networks come first, then the baselines in alphabetical order.
    let expected = [of("network", 2), of("network", 4), of("persistence", 2)];
    for (cell, expected) in cells.iter().zip(expected) {
        assert!(cell.starts_with(&harness::metrics::rounded(expected, "1")), "{cell} {expected}");
    }
    let data = data(page);
    let courses = data["course"].as_array().unwrap();
    // The elements of joints have several units, so only the two forces have predictions, of two networks each.
    assert!(!courses.is_empty());
    for course in courses {
        let text = |key: &str| course[key].as_str().unwrap();
        let place = format!(
            "modality = '{}' and index = {} and latent = {} and seed = 0 and episode = {} and task = 'prediction'",
            text("modality"),
            course["index"],
            course["latent"],
            course["episode"]
        );
        for (at, column) in [(1, "reference"), (2, "predicted")] {
            let stored = value(&format!("select {column} from predictions where {place} order by sample"));
            let shown: Vec<f64> = course["points"]
                .as_array()
                .unwrap()
                .iter()
                .map(|point| point[at].as_f64().unwrap())
                .collect();
            assert_eq!(shown.len(), stored.len(), "{place}");
            for (shown, stored) in shown.iter().zip(&stored) {
                assert!((shown - stored).abs() <= 1e-4 * stored.abs(), "{place}: {shown} {stored}");
            }
        }
        assert_eq!((course["seconds"].as_f64(), text("unit")), (Some(0.1), "N"));
    }
    // Each of the five stored samples has a reference and a prediction of each network.
    let images = between(page, "<section id=\"images\">", "</section>");
    assert_eq!(images.matches("<img src=\"data:image/png;base64,").count(), 5 * 3);
}

#[test]
fn a_page_of_a_world_that_is_gone_says_so() {
    let (results, _) = &*PENDULUM_PAGE;
    let copy = folder("report_gone");
    fs::remove_dir_all(&copy).unwrap();
    let copied = std::process::Command::new("cp").arg("-r").arg(results).arg(&copy).status().unwrap();
    assert!(copied.success());
    // The runs' records have the path of the world file, which is that of the first folder.
    let scenes_with = |world: &Path| {
        let runs = fs::read_dir(copy.join("runs/pendulum")).unwrap().flatten();
        for path in runs.map(|run| run.path().join("run.json")).filter(|path| path.exists()) {
            let mut record: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
            record["provenance"]["world_file"] = world.display().to_string().into();
            record[seal::KEY] = seal::BLANK.into();
            seal::write(&path, format!("{record:#}\n").into_bytes()).unwrap();
        }
        let page = page(&copy, "gone.html", &["pendulum"]);
        assert!(page.contains("<section id=\"metrics\">"));
        between(&page, "<section id=\"scenes\">", "</section>").to_owned()
    };
    // The model that is filmed is that of the dataset, whatever the file on the disk says now.
    fs::write(copy.join("pendulum.xml"), "<mujoco/>").unwrap();
    let scenes = scenes_with(&copy.join("pendulum.yaml"));
    assert!(!scenes.contains("could not be filmed") && scenes.contains("class=\"clip\""), "{scenes}");
    let scenes = scenes_with(Path::new("/nowhere/pendulum.yaml"));
    assert!(scenes.contains("The world pendulum could not be filmed: "), "{scenes}");
}

#[test]
fn what_is_not_predicted_is_named_without_a_command() {
    let results = folder("report_images");
    let settings = ["name=images", "output=[frame_difference]", "tasks=[prediction]", "seeds=[0]"];
    succeed(&results, &[&["run", SMOKE][..], &settings].concat());
    let page = page_without_pictures(&results, "report.html", &["images"]);
    let lacking =
        "These runs have no rows for other parts: by element, prediction over reference, over time.";
    assert!(between(&page, "<header>", "</header>").contains(lacking));
    assert_eq!(sections(&page), ["metrics", "images", "scenes", "figures", "training", "modalities", "runs"]);
    // The command would be `harness run images`, but there is no spec of this name.
    assert!(!page.contains("This command makes it") && !page.contains("Some runs are missing"), "{page}");
}

#[test]
fn directions_of_joints_and_links_are_those_of_the_world() {
    let (worlds, results) = (folder("report_worlds"), folder("report_directions"));
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("models");
    fs::copy(models.join("empty.xml"), worlds.join("empty.xml")).unwrap();
    let world = fs::read_to_string(models.join("empty.yaml")).unwrap();
    let groups = "fe: \"*[02468]\", aa: \"*[13579]\"";
    assert!(world.contains(groups));
    let swapped = worlds.join("swapped.yaml");
    fs::write(&swapped, world.replace(groups, "fe: \"*[13579]\", aa: \"*[02468]\"")).unwrap();
    let scenario = format!("scenarios=[{}]", swapped.display());
    succeed(&results, &["run", SMOKE, &scenario, "seeds=[0]", "tasks=[prediction]"]);
    let data = data(&page_without_pictures(&results, "report.html", &["smoke"]));
    let joints = data["joints"].as_array().unwrap();
    assert!(joints.iter().any(|row| row["modality"] == "contact_force"));
    for row in joints {
        let directions = row["directions"].as_array().unwrap();
        assert!(directions.len() == 20 && directions[0] == "aa" && directions[1] == "fe", "{row}");
    }
    let clouds = data["regression"].as_array().unwrap().iter();
    let ends: BTreeSet<(u64, &str)> = clouds
        .map(|cloud| (cloud["index"].as_u64().unwrap(), cloud["direction"].as_str().unwrap()))
        .collect();
    assert_eq!(ends, BTreeSet::from([(18, "aa"), (19, "fe")]));
}

#[test]
fn runs_of_several_settings_are_nowhere_put_together() {
    let results = folder("report_mixed");
    for batch in ["training.batch_size=16", "training.batch_size=32"] {
        let settings = ["latent=[2]", "scenarios=[cluttered]", "seeds=[0]", batch];
        succeed(&results, &[&["run", SINGLE][..], &TINY, &settings].concat());
    }
    let mixed = "The runs of single_to_multi differ in training.batch_size (16, 32); select some, for example with \
                 `--where 'single_to_multi:training.batch_size=";
    let page = page_without_pictures(&results, "report.html", &[]);
    for section in ["joints", "regression", "figures"] {
        let part = between(&page, &format!("<section id=\"{section}\">"), "</section>");
        assert!(unescaped(part).contains(mixed), "{part}");
    }
    assert!(unescaped(between(&page, "<header>", "</header>")).contains(mixed));
    assert_eq!(data(&page)["joints"], serde_json::json!([]));
    let forces = between(&page, "id=\"claim-force_errors_stay_high\"", "</details>");
    assert!(forces.contains("undecided: settings differ"), "{forces}");
    let option = ["--where", "training.batch_size=32"];
    let chosen = page_without_pictures(&results, "chosen.html", &option);
    assert!(!chosen.contains("settings differ") && chosen.contains("id=\"joints-chart\""));
    // The other run is not listed, and has no training curves.
    assert_eq!(chosen.matches("<details class=\"run\">").count(), 1);
    let training = data(&chosen)["training"].clone();
    let runs: BTreeSet<&str> =
        training.as_array().unwrap().iter().map(|curves| curves["run"].as_str().unwrap()).collect();
    assert_eq!(runs.len(), 1, "{runs:?}");
}

#[test]
fn without_an_opengl_driver_the_page_says_so_and_goes_on() {
    let results = folder("report_no_driver");
    let page = page_without_pictures(&results, "report.html", &[]);
    let scenes = between(&page, "<section id=\"scenes\">", "</section>");
    assert!(scenes.contains("no OpenGL context") && scenes.contains("apt-get install libegl1"), "{scenes}");
    assert!(page.contains("id=\"claim-"));
}

#[test]
fn a_page_that_cant_be_written_is_an_error_and_leaves_nothing() {
    let results = folder("report_refused");
    let out = results.join("file/report.html");
    fs::write(results.join("file"), "not a folder").unwrap();
    let answer = finish(&mut harness(&results, &["report", "--output", out.to_str().unwrap()]));
    assert_eq!(answer.code, 1);
    assert!(answer.stderr.contains(&format!("can't write {}: ", out.display())), "{}", answer.stderr);

    let claims = results.join("claims.yaml");
    let claim = "- id: x\n  paper: x\n  section: x\n  measured: x\n  experiments: []\n  condition: above 0\n";
    let wrong = format!("{claim}  query: select sed from metrics\n");
    let out = results.join("report.html");
    for (text, problem) in [("- id: [", "claims.yaml:1:"), (&wrong, "claims.yaml:7:10: claim 'x': ")] {
        fs::write(&claims, text).unwrap();
        let arguments = ["report", "--output", out.to_str().unwrap(), "--claims", claims.to_str().unwrap()];
        let mut command = harness(&results, &arguments);
        let answer = finish(command.env("__EGL_VENDOR_LIBRARY_FILENAMES", "/nonexistent.json"));
        assert_eq!(answer.code, 2, "{}", answer.stderr);
        assert!(answer.stderr.contains(problem), "{}", answer.stderr);
        assert!(!out.exists());
    }
}

const HOSTILE: &str =
    "</script><script>window.hostile=1</script><img src=x onerror=window.hostile=1>\"'{{7*7}}&lt;";

/// Results in which every text that someone else could have written is hostile, and their page with hostile claims.
pub static HOSTILE_PAGE: LazyLock<(PathBuf, String)> = LazyLock::new(|| {
    let results = smoke_run("report_hostile");
    let runs = fs::read_dir(results.join("runs/smoke")).unwrap().map(|run| run.unwrap().path());
    let run = runs.min().unwrap();
    // A folder's name may contain anything but a slash.
    let name = HOSTILE.replace('/', "");
    let experiment = results.join("runs").join(&name);
    fs::create_dir_all(&experiment).unwrap();
    let hostile = experiment.join(&name);
    fs::rename(run, &hostile).unwrap();
    let run = hostile;
    let record_path = run.join("run.json");
    let mut record: Value = serde_json::from_slice(&fs::read(&record_path).unwrap()).unwrap();
    for key in ["spec_hash", "dataset", "reason", "started"] {
        record[key] = HOSTILE.into();
    }
    for key in ["experiment", "run"] {
        record[key] = name.as_str().into();
    }
    for key in ["git_commit", "harness_version", "mujoco_version", "host", "processor", "command"] {
        record["provenance"][key] = HOSTILE.into();
    }
    record["spec"]["variant"] = HOSTILE.into();
    let path = run.join("epochs.parquet");
    let mut epochs = TableFile::open(&path).unwrap().table(None).unwrap();
    for (column, value) in [("experiment", name.as_str()), ("run", &name), ("term", HOSTILE)] {
        let values: Column = Column::new(column.into(), vec![value; epochs.height()]);
        epochs.with_column(values.into_column()).unwrap();
    }
    let columns = harness::schema::Table::Epochs.columns();
    write_table(&path, epochs, &columns, &harness::tables::Stamp::new()).unwrap();
    let bytes = fs::read(&path).unwrap();
    record["files"]["epochs.parquet"]["bytes"] = bytes.len().into();
    record["files"]["epochs.parquet"]["sha256"] = hex(&Sha256::digest(&bytes)).into();
    record[seal::KEY] = seal::BLANK.into();
    seal::write(&record_path, format!("{record:#}\n").into_bytes()).unwrap();

    let claims = results.join("claims.yaml");
    let quoted = serde_json::to_string(HOSTILE).unwrap();
    let claim = format!(
        "- id: {quoted}\n  paper: {quoted}\n  section: {quoted}\n  measured: {quoted}\n  experiments: [{quoted}, smoke]\n  \
         query: |\n    select seed, avg(value) as value from metrics where run <> {} group by seed\n  \
         condition: above 0\n",
        "'</pre><script>window.hostile=1</script>'"
    );
    fs::write(&claims, claim).unwrap();
    let page = page_without_pictures(&results, "report.html", &["--claims", claims.to_str().unwrap()]);
    (results, page)
});

#[test]
fn hostile_text_stays_text() {
    let (results, page) = &*HOSTILE_PAGE;
    assert!(!page.contains("<script>window") && !page.contains("<img src=x"));
    // The page has two scripts: the data, and its own.
    assert_eq!(page.matches("<script").count(), 2);
    assert_eq!(page.matches("</script").count(), 2);
    let shown = escaped(HOSTILE);
    // The claim's name (twice), its text, section, measured quantity and command are shown, and each changed field of
    // the run.
    assert!(page.matches(shown.as_str()).count() >= 4 + 8, "{}", page.matches(shown.as_str()).count());
    let name = HOSTILE.replace('/', "");
    assert!(page.contains(&escaped(&name)));
    let own = page_without_pictures(results, "own.html", &[&name]);
    assert_eq!(between(&own, "<h1>", "</h1>"), escaped(&name));
    assert_eq!((own.matches("<script").count(), own.matches("</script").count()), (2, 2));
    // The script's data have the text unchanged.
    let training = &data(page)["training"];
    let runs: BTreeSet<&str> =
        training.as_array().unwrap().iter().map(|row| row["run"].as_str().unwrap()).collect();
    assert!(runs.contains(name.as_str()), "{runs:?}");
}

/// Reads a page, in which there must be no error.
fn read_page(page: &Path, results: &Path, more: &[&str]) {
    if let Some((well, said)) = in_chromium("read_page.py", &[page, results], more) {
        assert!(well && said.contains("the page reads well"), "{said}");
    }
}

/// A server that answers every request with an empty style sheet, and its address.
fn serve_styles() -> String {
    let server = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("http://{}/style.css", server.local_addr().unwrap());
    std::thread::spawn(move || {
        for mut asked in server.incoming().flatten() {
            // A browser may open a connection on which it asks for nothing.
            std::thread::spawn(move || {
                let _ = asked.read(&mut [0; 4096]);
                let head = "HTTP/1.1 200 OK\r\nContent-Type: text/css\r\nContent-Length: 0\r\nConnection: \
                            close\r\n\r\n";
                let _ = asked.write_all(head.as_bytes());
            });
        }
    });
    address
}

/// At the same time, Chromium loads a page of its own in another tab.
#[test]
fn only_what_a_page_itself_asks_for_is_noticed_in_chromium() {
    let folder = folder("quiet");
    let (quiet, loud) = (folder.join("quiet.html"), folder.join("loud.html"));
    fs::write(&quiet, "<p>quiet").unwrap();
    read_page(&quiet, &folder, &["--quiet"]);
    let address = serve_styles();
    fs::write(&loud, format!("<link rel=\"stylesheet\" href=\"{address}\"><p>loud")).unwrap();
    if let Some((well, said)) = in_chromium("read_page.py", &[&loud, &folder], &["--quiet"]) {
        assert!(!well && said.contains(&format!("AssertionError: {address}")), "{said}");
    }
}

#[test]
fn a_reader_can_use_the_page_in_chromium() {
    let _ = &*PAGE;
    read_page(&RESULTS.join("report.html"), &RESULTS, &[]);
}

#[test]
fn pages_of_other_robots_can_be_read_in_chromium() {
    for (results, _) in [&*PENDULUM_PAGE, &*ABLATION_PAGE, &*ROPE_PAGE] {
        read_page(&results.join("report.html"), results, &["--robot"]);
    }
}

#[test]
fn hostile_text_does_nothing_in_chromium() {
    let (results, _) = &*HOSTILE_PAGE;
    read_page(&results.join("report.html"), results, &["--hostile"]);
}
