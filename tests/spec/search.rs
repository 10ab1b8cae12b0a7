//! Searches: which trials a spec expands to, how their settings are distributed, and which searches are refused.

use super::{BASE, ROOT, base_with, load, load_with, refusal};
use harness_spec::{Candidates, Experiment, Halving, Method, Search, Task, Trial};
use harness_spec::{SOBOL_DIMENSIONS, sobol};
use serde_json::json;
use std::collections::{BTreeMap, BTreeSet};

/// A search over four settings of a single run.
const SEARCH: &str = "\
search:
  method: random
  trials: 4
  space:
    network.hidden: {choice: [16, [32, 32]]}
    training.batch_size: {integer: [16, 64]}
    training.learning_rate: {log_uniform: [0.0001, 0.01]}
    training.weight_decay: {uniform: [0, 0.5]}
  objective: {term: contact_force}
";

/// The base spec with one scenario and one latent size, and a section `search`.
fn spec_with(search: &str) -> String {
    base_with("latent: [2]").replace("[empty, cluttered]", "[empty]") + search
}

fn search(method: Method, trials: usize, space: &[(&str, Candidates)]) -> Search {
    let space = space.iter().map(|(key, candidates)| ((*key).to_owned(), candidates.clone())).collect();
    Search { method, trials, seed: 0, space, objective: Default::default(), halving: None }
}

/// The values of one setting in each trial.
fn values(trials: &[Trial], key: &str) -> Vec<f64> {
    trials.iter().map(|trial| trial[key].as_f64().unwrap()).collect()
}

fn variants(experiment: &Experiment) -> Vec<String> {
    experiment.runs().into_iter().map(|run| run.variant).collect()
}

// --- what is drawn ---

#[test]
fn sobol_points_are_those_of_scipy() {
    let output = std::process::Command::new(format!("{ROOT}/.venv/bin/python"))
        .arg(format!("{ROOT}/tests/python/reference_sobol.py"))
        .args(["1024", &SOBOL_DIMENSIONS.to_string()])
        .output()
        .expect("the virtual environment of the tests is there: `make test` sets it up");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let expected: Vec<Vec<u32>> = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(expected.len(), 1024);
    for (point, expected) in (0..).zip(expected) {
        let found: Vec<u32> = (0..SOBOL_DIMENSIONS).map(|dimension| sobol(point, dimension)).collect();
        assert_eq!(found, expected, "point {point}");
    }
}

/// The trials of published searches must not change.
#[test]
fn the_trials_of_a_search_are_pinned() {
    assert_eq!(
        variants(&load(&spec_with(SEARCH))),
        [
            "trial=0000,hidden=32+32,batch_size=37,learning_rate=0.000169455,weight_decay=0.41835",
            "trial=0001,hidden=32+32,batch_size=62,learning_rate=0.00466098,weight_decay=0.119078",
            "trial=0002,hidden=32+32,batch_size=19,learning_rate=0.00248483,weight_decay=0.0816531",
            "trial=0003,hidden=16,batch_size=36,learning_rate=0.000457138,weight_decay=0.194002"
        ]
    );
    assert_eq!(
        variants(&load(&spec_with(&SEARCH.replace("random", "sobol")))),
        [
            "trial=0000,hidden=32+32,batch_size=54,learning_rate=0.000146912,weight_decay=0.129383",
            "trial=0001,hidden=16,batch_size=29,learning_rate=0.00146912,weight_decay=0.379383",
            "trial=0002,hidden=16,batch_size=42,learning_rate=0.000464576,weight_decay=0.00438335",
            "trial=0003,hidden=32+32,batch_size=17,learning_rate=0.00464576,weight_decay=0.254383"
        ]
    );
}

#[test]
fn a_search_with_more_trials_begins_with_the_same_ones() {
    for method in ["random", "sobol"] {
        let of = |trials: usize| {
            let search = SEARCH.replace("random", method).replace("trials: 4", &format!("trials: {trials}"));
            load(&spec_with(&search)).runs()
        };
        assert_eq!(of(50)[..20], of(20));
    }
}

#[test]
fn the_seed_changes_every_trial() {
    for method in ["random", "sobol"] {
        let of = |seed: u64| {
            let search = SEARCH.replace("random", method) + &format!("  seed: {seed}\n");
            variants(&load(&spec_with(&search))).into_iter().collect::<BTreeSet<_>>()
        };
        assert_eq!(of(0), of(0));
        assert!(of(0).is_disjoint(&of(1)));
    }
}

/// The share of values below a quantile deviates from it by less than 4 standard deviations.
#[test]
fn random_values_have_the_quantiles_of_their_distribution() {
    const TRIALS: usize = 10_000;
    let space = [
        ("uniform", Candidates::Uniform([-2.0, 6.0])),
        ("log", Candidates::LogUniform([1e-4, 1.0])),
        ("integer", Candidates::Integer([-1, 2])),
        ("choice", Candidates::Choice(vec![json!("a"), json!(null), json!([1, 2])])),
    ];
    let trials = search(Method::Random, TRIALS, &space).draw();
    let near = |count: usize, share: f64, what: &str| {
        let deviation = (share * (1.0 - share) / TRIALS as f64).sqrt();
        let found = count as f64 / TRIALS as f64;
        assert!((found - share).abs() < 4.0 * deviation, "{what}: {found} instead of {share}");
    };
    let (uniform, log) = (values(&trials, "uniform"), values(&trials, "log"));
    assert!(uniform.iter().all(|value| (-2.0..=6.0).contains(value)));
    assert!(log.iter().all(|value| (1e-4..=1.0).contains(value)));
    for share in [0.05, 0.25, 0.5, 0.75, 0.95] {
        let below = |values: &[f64], bound: f64| values.iter().filter(|value| **value < bound).count();
        near(below(&uniform, -2.0 + 8.0 * share), share, "uniform");
        near(below(&log, 10_f64.powf(-4.0 + 4.0 * share)), share, "log-uniform");
    }
    let counts = |key: &str| {
        trials.iter().fold(BTreeMap::new(), |mut counts: BTreeMap<String, usize>, trial| {
            *counts.entry(trial[key].to_string()).or_default() += 1;
            counts
        })
    };
    for (key, expected) in
        [("integer", vec!["-1", "0", "1", "2"]), ("choice", vec!["\"a\"", "[1,2]", "null"])]
    {
        let counts = counts(key);
        assert_eq!(counts.keys().collect::<Vec<_>>(), expected);
        counts.values().for_each(|count| near(*count, 1.0 / expected.len() as f64, key));
    }
    // The settings are independent: a quarter of the trials has both below their medians.
    let both = uniform.iter().zip(&log).filter(|(uniform, log)| **uniform < 2.0 && **log < 0.01).count();
    near(both, 0.25, "both");
}

/// Of 2^k points of a Sobol sequence, each of 2^k equal intervals of every coordinate has one, and each square of the
/// first two coordinates with that area has one (a (0, k, 2)-net, which the shift preserves).
#[test]
fn a_sobol_search_covers_its_space_evenly() {
    let keys: Vec<String> = (0..SOBOL_DIMENSIONS).map(|index| format!("x{index:02}")).collect();
    let space: Vec<(&str, Candidates)> =
        keys.iter().map(|key| (key.as_str(), Candidates::Uniform([0.0, 1.0]))).collect();
    let trials = search(Method::Sobol, 64, &space).draw();
    for key in &keys {
        let cells: BTreeSet<usize> = values(&trials, key).iter().map(|x| (x * 64.0) as usize).collect();
        assert_eq!(cells.len(), 64, "{key}");
    }
    let squares = values(&trials, "x00").into_iter().zip(values(&trials, "x01"));
    let squares: BTreeSet<[usize; 2]> = squares.map(|(x, y)| [x, y].map(|x| (x * 8.0) as usize)).collect();
    assert_eq!(squares.len(), 64);
}

#[test]
fn drawn_numbers_have_six_significant_digits_within_their_range() {
    let ranges = [[0.123456789, 0.123456799], [1.0 / 3.0, 2.0 / 3.0], [1e-9, 1e-3]];
    for range in ranges {
        for candidates in [Candidates::Uniform(range), Candidates::LogUniform(range)] {
            let trials = search(Method::Random, 200, &[("x", candidates)]).draw();
            for value in values(&trials, "x") {
                let is_bound = range.contains(&value);
                assert!(range[0] <= value && value <= range[1], "{value}");
                assert!(is_bound || format!("{value:.5e}").parse() == Ok(value), "{value}");
            }
        }
    }
}

// --- the runs ---

#[test]
fn a_trial_is_a_run_with_the_drawn_settings() {
    let text = spec_with(SEARCH).replace("name: base", "name: base\nseeds: [0, 1]")
        + "vary: {training.kl_weight: [0, 0.001]}\n";
    let experiment = load(&text);
    let runs = experiment.runs();
    assert_eq!(runs.len(), 2 * 4 * 2);
    let trials = experiment.search.as_ref().unwrap().draw();
    for (index, run) in runs.iter().enumerate() {
        let (varied, number, seed) = (index / 8, index / 2 % 4, index % 2);
        let trial = &trials[number];
        assert_eq!(run.trial(), Some(number));
        assert_eq!(json!(run.trained().unwrap().training.learning_rate), trial["training.learning_rate"]);
        assert_eq!(json!(run.trained().unwrap().training.weight_decay), trial["training.weight_decay"]);
        assert_eq!(json!(run.trained().unwrap().training.batch_size), trial["training.batch_size"]);
        assert_eq!(json!(run.trained().unwrap().network.hidden), trial["network.hidden"]);
        let kl_weight = ["0", "0.001"][varied];
        assert_eq!(run.label(), format!("empty-z2-kl_weight={kl_weight},trial=000{number}-seed{seed}"));
        let start = format!("kl_weight={kl_weight},trial=000{number},hidden=");
        assert!(run.variant.starts_with(&start), "{}", run.variant);
        let (varied, number, settings) = run.variant_parts();
        assert_eq!(format!("{varied},trial={},{settings}", number.unwrap()), run.variant);
    }
    let labels: BTreeSet<String> = runs.iter().map(|run| run.label()).collect();
    assert_eq!(labels.len(), runs.len());
    assert_eq!(load(&experiment.to_yaml()), experiment);
    let plain = load(BASE).runs().remove(0);
    assert_eq!((plain.trial(), plain.variant_parts()), (None, ("", None, "")));
}

#[test]
fn a_drawn_setting_that_is_given_has_that_value_alone() {
    let text = spec_with(SEARCH) + "quick: {training.learning_rate: 0.5, search.trials: 2}\n";
    let drawn = load(&text).runs();
    let quick = load_with(&text, &[], true).unwrap().runs();
    assert_eq!(quick.len(), 2);
    let rates = |runs: &[harness_spec::RunSpec]| -> Vec<f64> {
        runs.iter().map(|run| run.trained().unwrap().training.learning_rate).collect()
    };
    assert_eq!(rates(&quick), [0.5, 0.5]);
    let given = load_with(&text, &["network.hidden=8", "training.learning_rate=0.25"], false).unwrap().runs();
    assert_eq!(rates(&given), [0.25; 4]);
    for (given, drawn) in given.iter().zip(&drawn) {
        assert_eq!(given.trained().unwrap().network.hidden, [8]);
        assert_eq!(
            given.trained().unwrap().training.batch_size,
            drawn.trained().unwrap().training.batch_size,
            "the others stay"
        );
    }
    // The order of the overrides does not matter.
    let space = "search.space={training.learning_rate: {uniform: [0.1, 0.2]}}";
    let both = [space, "training.learning_rate=0.25"];
    for overrides in [both, [both[1], both[0]]] {
        assert_eq!(rates(&load_with(&text, &overrides, false).unwrap().runs()), [0.25; 4]);
    }
    let without = load_with(&text, &["search=null", "training.learning_rate=0.25"], false).unwrap();
    let expected = load(&spec_with("training: {learning_rate: 0.25}\n"));
    assert_eq!(without.runs(), expected.runs());
}

#[test]
fn the_rungs_of_a_run_differ_from_it_in_their_last_epoch() {
    let halving = Halving { eta: 3, min_epochs: 2 };
    assert_eq!(halving.rungs(20), [2, 6, 18, 20]);
    assert_eq!(halving.rungs(18), [2, 6, 18]);
    assert_eq!([27, 9, 8, 3, 2, 1].map(|trials| halving.kept(trials)), [9, 3, 2, 1, 1, 1]);
    let text = spec_with(SEARCH) + "  halving: {eta: 3, min_epochs: 2}\ntraining: {epochs: 10}\n";
    let experiment = load(&text);
    let run = experiment.runs().remove(1);
    let rungs = experiment.rungs(&run);
    let epochs: Vec<Option<usize>> =
        rungs.iter().map(|rung| rung.trained().unwrap().training.last_epoch).collect();
    assert_eq!(epochs, [Some(2), Some(6), None]);
    assert_eq!(rungs[2], run);
    assert_eq!(run, load(&(spec_with(SEARCH) + "training: {epochs: 10}\n")).runs()[1]);
    for rung in &rungs[..2] {
        assert_eq!((rung.label(), &rung.tasks), (run.label(), &vec![Task::Prediction]));
        assert_eq!(
            (rung.trained().unwrap().training.epochs, rung.trained().unwrap().training.learning_rate),
            (10, run.trained().unwrap().training.learning_rate)
        );
    }
    let hashes: BTreeSet<String> = rungs.iter().map(|rung| rung.hash()).collect();
    assert_eq!(hashes.len(), 3);
    assert_eq!(load(&spec_with(SEARCH)).rungs(&run), std::slice::from_ref(&run));
}

// --- what is refused ---

#[test]
fn a_search_that_cannot_be_drawn_or_compared_is_refused() {
    let rate = "training.learning_rate: {log_uniform: [0.0001, 0.01]}";
    let cases = [
        (
            "method: random",
            "method: grid",
            "spec.yaml:8:11: unknown method 'grid' in 'search.method'. Allowed: random, sobol",
        ),
        (
            "method: random\n",
            "methods: random\n",
            "spec.yaml:8:3: unknown key 'methods' in 'search'; did you mean 'method'? Allowed: method, trials, seed, \
             space, objective, halving",
        ),
        ("  method: random\n", "", "spec.yaml:8:3: missing 'search.method'"),
        (
            "trials: 4",
            "trials: 0",
            "spec.yaml:9:11: 'search.trials': expected an integer of at least 1 and at most 10000, found 0",
        ),
        (
            "trials: 4",
            "trials: 10001",
            "spec.yaml:9:11: 'search.trials': expected an integer of at least 1 and at most 10000, found 10001",
        ),
        (
            "trials: 4",
            "trials: 4\n  seed: -1",
            "spec.yaml:10:9: 'search.seed': expected an integer of at least 0 and at most 9007199254740991, found -1",
        ),
        (
            "learning_rate: {log_uniform",
            "learning_rate: {log_unifrom",
            "spec.yaml:13:30: unknown key 'log_unifrom' in 'search.space.training.learning_rate'; did you mean \
             'log_uniform'? Allowed: uniform, log_uniform, choice",
        ),
        (
            "learning_rate: {log_uniform",
            "learning_rat: {log_uniform",
            "spec.yaml:13:5: unknown key 'training.learning_rat' in 'search.space'; did you mean \
             'training.learning_rate'?",
        ),
        (
            rate,
            "simulation.episodes: {integer: [4, 8]}",
            "spec.yaml:13:5: unknown key 'simulation.episodes' in 'search.space'. Allowed: input, outputs.…, action, \
             network.…, training.…",
        ),
        (
            rate,
            "training.learning_rate: 0.001",
            "spec.yaml:13:29: 'search.space.training.learning_rate': expected a section with exactly one of uniform, \
             log_uniform, choice, found 0.001",
        ),
        (
            rate,
            "training.learning_rate: {}",
            "spec.yaml:13:29: 'search.space.training.learning_rate': expected a section with exactly one of uniform, \
             log_uniform, choice, found an empty section",
        ),
        (
            rate,
            "training.learning_rate: {uniform: [0.1, 0.2], choice: [0.1]}",
            "spec.yaml:13:29: 'search.space.training.learning_rate': expected a section with exactly one of uniform, \
             log_uniform, choice, found a section of keys",
        ),
        (
            "[0.0001, 0.01]",
            "[0.01, 0.0001]",
            "spec.yaml:13:43: 'log_uniform' needs a lowest value below the highest; found 0.01 and 0.0001",
        ),
        (
            "[0.0001, 0.01]",
            "[0.01]",
            "spec.yaml:13:43: 'search.space.training.learning_rate.log_uniform': expected a list of 2 items, each a \
             finite number above 0 and at most 1, found a list of 1",
        ),
        (
            "{uniform: [0, 0.5]}",
            "{log_uniform: [0, 0.5]}",
            "spec.yaml:14:42: 'log_uniform' draws values above 0; the lowest is 0",
        ),
        (
            "[0.0001, 0.01]",
            "[0.0001, 2]",
            "spec.yaml:13:52: 'search.space.training.learning_rate.log_uniform': expected a finite number above 0 and \
             at most 1, found 2",
        ),
        (
            "{integer: [16, 64]}",
            "{uniform: [16, 64]}",
            "spec.yaml:12:27: unknown key 'uniform' in 'search.space.training.batch_size'. Allowed: integer, choice",
        ),
        (
            "{integer: [16, 64]}",
            "{integer: [16, 64.5]}",
            "spec.yaml:12:41: 'search.space.training.batch_size.integer': expected an integer of at least 1 and at \
             most 65536, found 64.5",
        ),
        (
            "{integer: [16, 64]}",
            "{integer: [16, 16]}",
            "spec.yaml:12:36: 'integer' needs a lowest value below the highest; found 16 and 16",
        ),
        (
            "{choice: [16, [32, 32]]}",
            "{choice: []}",
            "spec.yaml:11:30: 'search.space.network.hidden.choice': expected a list of at least one item, each a list \
             of one to 16 items, each an integer of at least 1 and at most 16384, found an empty list",
        ),
        (
            "{choice: [16, [32, 32]]}",
            "{choice: [16, 16]}",
            "spec.yaml:11:35: [16] is in 'search.space.network.hidden.choice' twice",
        ),
        (
            "{choice: [16, [32, 32]]}",
            "{choice: [0]}",
            "spec.yaml:11:31: 'search.space.network.hidden.choice': expected an integer of at least 1 and at most \
             16384, found 0",
        ),
        (
            "term: contact_force",
            "term: contact_froce",
            "spec.yaml:15:21: unknown term 'contact_froce' in 'search.objective.term'; did you mean 'contact_force'? \
             Allowed: proprioception, contact_force, total",
        ),
        (
            "{term: contact_force}",
            "{term: contact_force, split: test}",
            "spec.yaml:15:43: unknown samples 'test' in 'search.objective.split'. Allowed: validation; a choice by the \
             test samples would make their errors too small",
        ),
        (
            "{term: contact_force}",
            "{metric: r2}",
            "spec.yaml:15:15: unknown key 'metric' in 'search.objective'. Allowed: term, split",
        ),
        (
            "  objective: {term: contact_force}\n",
            "    training.kl_weight: {uniform: [0, 1]}\n",
            "spec.yaml:15:25: the objective 'total' depends on 'training.kl_weight', so trials can't be compared by \
             it; leave 'training.kl_weight' out, or set search.objective.term to proprioception or contact_force",
        ),
        (
            rate,
            "training.losses.contact_force: {choice: [squared, huber]}",
            "spec.yaml:13:36: the objective 'contact_force' depends on 'training.losses.contact_force', so trials \
             can't be compared by it; leave 'training.losses.contact_force' out, or set search.objective.term to \
             proprioception",
        ),
        (
            rate,
            "outputs.contact_force.loss: {choice: [squared, huber]}",
            "spec.yaml:13:33: the objective 'contact_force' depends on 'outputs.contact_force.loss', so trials can't \
             be compared by it; leave 'outputs.contact_force.loss' out, or set search.objective.term to proprioception",
        ),
        (
            "search:\n",
            "vary: {training.learning_rate: [0.1, 0.2]}\nsearch:\n",
            "spec.yaml:14:29: 'training.learning_rate' is also in 'vary'; leave it out of one of them",
        ),
        (
            "search:\n",
            "vary: {role: {one: {training.learning_rate: 0.1}}}\nsearch:\n",
            "spec.yaml:14:29: 'training.learning_rate' is also in 'vary.role'; leave it out of one of them",
        ),
        (
            "{term: contact_force}\n",
            "{term: contact_force}\n  halving: {eta: 1, min_epochs: 2}\n",
            "spec.yaml:16:18: 'search.halving.eta': expected an integer of at least 2 and at most 100, found 1",
        ),
        (
            "{term: contact_force}\n",
            "{term: contact_force}\n  halving: {min_epochs: 200}\n",
            "spec.yaml:16:25: 200 epochs are not less than training.epochs, 200, so no trial would be stopped; use \
             fewer",
        ),
        (
            "{term: contact_force}\n",
            "{term: contact_force}\n  halving: {min_epochs: 2}\ntraining: {last_epoch: 5}\n",
            "spec.yaml:17:24: successive halving sets it; leave it out",
        ),
        (
            "  objective: {term: contact_force}\n",
            "    training.epochs: {integer: [10, 20]}\n  objective: {term: contact_force}\n  halving: {min_epochs: \
             2}\n",
            "spec.yaml:15:22: halving compares trials after the same epochs; leave 'training.epochs' out",
        ),
        (
            "{uniform: [0, 0.5]}",
            "{uniform: [1000, 1000000]}",
            "spec.yaml:14:28: a step takes learning_rate times weight_decay of each weight away, here more than all of \
             it; use 5901.271724056534 at most (after applying \
             trial=0000,hidden=32+32,batch_size=37,learning_rate=0.000169455,weight_decay=836864.0)",
        ),
        (
            "search:\n",
            "training: {last_epoch: 200}\nsearch:\n",
            "spec.yaml:7:24: the training ends after epoch 200 (training.epochs) anyway; use less than 200, or leave \
             it out",
        ),
    ];
    for (old, new, expected) in cases {
        let text = spec_with(SEARCH).replace(old, new);
        assert!(text != spec_with(SEARCH), "{old}");
        let found = refusal(&text);
        // The settings that may be drawn are many.
        let is_expected =
            if expected.ends_with(',') { found.starts_with(expected) } else { found == expected };
        assert!(is_expected, "{new}: {found}");
    }
}

#[test]
fn a_sobol_sequence_has_a_dimension_for_every_drawn_setting() {
    let schema = harness_spec::schema();
    let settings = schema["$defs"]["Search"]["properties"]["space"]["properties"].as_object().unwrap();
    assert!((20..=SOBOL_DIMENSIONS).contains(&settings.len()), "{}", settings.len());
}

#[test]
fn an_override_of_a_search_is_refused_by_its_name() {
    let said = |spec: &str, text: &str| load_with(spec, &[text], false).unwrap_err();
    let search = spec_with(SEARCH);
    for (spec, text, expected) in [
        (
            &*search,
            "search.trials=0",
            "'search.trials': expected an integer of at least 1 and at most 10000, found 0",
        ),
        (
            &search,
            "search.space={training.learning_rate: {uniform: [0.2, 0.1]}}",
            "'uniform' needs a lowest value below the highest; found 0.2 and 0.1",
        ),
        (
            &search,
            "search.objective.split=test",
            "unknown samples 'test' in 'search.objective.split'. Allowed: validation; a choice by the test samples \
             would make their errors too small",
        ),
        (BASE, "search.trials=3", "missing 'search.method', 'search.space'"),
    ] {
        assert_eq!(said(spec, text), format!("override '{text}': {expected}"));
    }
}

#[test]
fn too_many_runs_are_refused_before_they_are_drawn() {
    let text = spec_with(&SEARCH.replace("trials: 4", "trials: 10000"))
        .replace("name: base", "name: base\nseeds: [0, 1]");
    assert_eq!(
        refusal(text),
        "spec.yaml:10:11: 1 scenarios, 1 latent sizes, 10000 combinations of settings and 2 seeds make 20000 runs, \
         more than the 10000 that are allowed; divide them over several experiments"
    );
}
