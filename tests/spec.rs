//! Specs: which are loaded, which are refused with which message, and which runs are the same.

use harness_spec::{
    self as spec, Action, Candidates, Definition, Division, Experiment, Fusion, GivenScaling, Layout, Loss,
    Memory, Method, Modality, Network, Origin, Preset, Scale, Scaling, Scalings, Scenario, Schedule, Search,
    Setting, Simulation, Split, SplitCounts, Stop, Task, Training, Window, World, read_mapping,
};
use rand::seq::{IndexedRandom, SliceRandom};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::Value;
use std::fs;
use std::path::Path;

#[path = "spec/mappings.rs"]
mod mappings;
#[path = "spec/other_world.rs"]
mod other_world;
#[path = "spec/search.rs"]
mod search;

/// Path of the repository.
const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");

/// A valid spec of 6 lines. Lines that a test adds start at line 7.
const BASE: &str = "\
name: base
scenarios: [empty, cluttered]
input: [proprioception, arm]
output: [proprioception, contact_force]
latent: [2, 4]
network: {preset: single_to_multi}
";

fn load_with(text: impl AsRef<[u8]>, overrides: &[&str], quick: bool) -> Result<Experiment, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("spec.yaml");
    fs::write(&path, text).unwrap();
    let overrides: Vec<String> = overrides.iter().map(|text| text.to_string()).collect();
    let prefix = format!("{}/", folder.path().display());
    spec::load(&path, &overrides, quick).map_err(|error| error.to_string().replace(&prefix, ""))
}

fn load(text: &str) -> Experiment {
    load_with(text, &[], false).unwrap()
}

/// The error message for an invalid spec.
fn refusal(text: impl AsRef<[u8]>) -> String {
    load_with(text, &[], false).unwrap_err()
}

/// The error message for an invalid override of the valid spec.
fn override_refusal(text: &str) -> String {
    load_with(BASE, &[text], false).unwrap_err()
}

/// The valid spec with one line replaced.
fn base_with(line: &str) -> String {
    let key = line.split_once(':').unwrap().0;
    let lines = BASE.lines().map(|old| if old.starts_with(&format!("{key}:")) { line } else { old });
    lines.flat_map(|line| [line, "\n"]).collect()
}

fn assert_refused(cases: &[(&str, &str)]) {
    for (addition, expected) in cases {
        assert_eq!(refusal(format!("{BASE}{addition}")), *expected, "after adding {addition:?}");
    }
}

#[test]
fn what_is_left_out_gets_its_default() {
    let expected = Experiment {
        name: "base".into(),
        description: String::new(),
        scenarios: vec![Scenario::EMPTY.into(), Scenario::CLUTTERED.into()],
        input: vec![Modality::PROPRIOCEPTION, Modality::ARM],
        output: vec![Modality::PROPRIOCEPTION, Modality::CONTACT_FORCE],
        outputs: Default::default(),
        inputs: Default::default(),
        latent: vec![2, 4],
        seeds: vec![0],
        tasks: vec![Task::Prediction, Task::Reconstruction],
        action: Action::Increment,
        window: Window::TRANSITION,
        network: Network {
            preset: Preset::SingleToMulti,
            hidden: vec![256],
            channels: Some(Vec::new()),
            ..Network::default()
        },
        simulation: World::paper(Scenario::CLUTTERED).simulation(),
        split: Split::default(),
        test: None,
        given: Vec::new(),
        probes: Vec::new(),
        scaling: Default::default(),
        training: Training {
            loss_weights: [(Modality::PROPRIOCEPTION, 1.0), (Modality::CONTACT_FORCE, 1.0)].into(),
            precision: harness_spec::Precision::F32,
            device: harness_spec::Device::Cpu,
            ..Training::default()
        },
        vary: Default::default(),
        search: None,
        readings: Vec::new(),
        quick: Default::default(),
        worlds: Vec::new(),
    };
    assert_eq!(load(BASE), expected);
}

#[test]
fn tests_with_some_inputs_follow_from_the_inputs() {
    let subsets = |text: &str| -> Vec<Vec<Modality>> {
        let run = load(&format!("{BASE}{text}")).runs().remove(0);
        run.given.iter().map(spec::Given::inputs).collect()
    };
    let one = [vec![Modality::PROPRIOCEPTION], vec![Modality::ARM]];
    for given in ["each", "without_each", "[each, without_each, [arm]]", "[[arm], [proprioception]]"] {
        assert_eq!(subsets(&format!("given: {given}\n")), one, "{given}");
    }
    // The test with all inputs is no further one, and a run without further ones has the name that it had before.
    assert_eq!(subsets("given: [all, [arm, proprioception]]\n"), Vec::<Vec<Modality>>::new());
    let hash = |text: &str| load(&format!("{BASE}{text}")).runs()[0].hash();
    assert_eq!(hash("given: all\ntraining: {modality_dropout: 0}\n"), hash(""));
    assert_ne!(hash("training: {modality_dropout: 0.1}\n"), hash(""));
    let of = |text: &str| load(&format!("{BASE}{text}")).training.modality_dropout;
    let each = "training: {modality_dropout: {arm: 0.1, proprioception: 0.1}}\n";
    assert_eq!(of("training: {modality_dropout: 0.1}\n"), of(each));
    let together = "training: {modality_dropout: [{inputs: [arm], probability: 0.1}]}\n";
    assert!(hash(together) != hash("") && of(together) != of(each));
    assert_eq!(hash("training: {modality_dropout: [{inputs: [arm], probability: 0}]}\n"), hash(""));
    // A single input is never lacking.
    let varied =
        load(&format!("{BASE}given: each\ntraining: {{modality_dropout: 0.1}}\nvary: {{input: [[arm]]}}\n"));
    let run = varied.runs().remove(0);
    assert_eq!(
        (run.given.len(), &run.trained().unwrap().training.modality_dropout),
        (0, &Default::default())
    );
    assert_refused(&[
        ("given: [[vision]]\n", "spec.yaml:7:10: unknown input 'vision'. Allowed: proprioception, arm"),
        (
            "given: some\n",
            "spec.yaml:7:8: 'given': expected one of all, each, without_each or a list of at least one item, each one of proprioception, arm, contact_force, contact_force_mean, vision, \
             frame_difference, or a modality of another world or dataset or a section of keys, found the text 'some'",
        ),
        (
            "training: {modality_dropout: {vision: 0.1}}\n",
            "spec.yaml:7:39: unknown input 'vision'. Allowed: proprioception, arm",
        ),
        (
            "training: {modality_dropout: [{inputs: [vision], probability: 0.1}]}\n",
            "spec.yaml:7:41: unknown input 'vision'. Allowed: proprioception, arm",
        ),
        (
            "training: {modality_dropout: [{inputs: [arm, proprioception], probability: 0.1}]}\n",
            "spec.yaml:7:40: name at least one input, and not all of them, \
             because a network needs an input",
        ),
        (
            "training: {modality_dropout: [{inputs: [arm], probability: 0.7}, {inputs: [arm], probability: 0.2}, {inputs: [arm], probability: 0.1}]}\n",
            "spec.yaml:7:30: the probabilities are 1 or more together; a window lacks \
             one item at most",
        ),
        (
            "training: {modality_dropout: 1}\n",
            "spec.yaml:7:30: 'training.modality_dropout': expected a finite number of at least 0 and below 1 or a \
             section of keys or a list of items, each a section of keys, found 1",
        ),
    ]);
}

#[test]
fn tests_and_dropout_of_an_input_that_an_axis_leaves_out_are_refused_with_what_to_do() {
    for (key, setting) in [
        ("given", "given: [[arm]]\n"),
        ("training.modality_dropout", "training: {modality_dropout: [{inputs: [arm], probability: 0.1}]}\n"),
    ] {
        for axis in [
            "input: {without: each}",
            "input: [[arm], [proprioception]]",
            "senses: {one: {input: [proprioception]}}",
        ] {
            let said = refusal(format!("{BASE}{setting}vary: {{{axis}}}\n"));
            let hint = format!(
                "; 'vary' changes the input, so give {key} to the labels of an axis, each with its own input"
            );
            assert!(said.starts_with("spec.yaml:7:") && said.contains(&hint), "{axis}: {said}");
        }
        assert!(!refusal(format!("{BASE}{}", setting.replace("arm", "vision"))).contains("'vary'"));
    }
    let value = "[{inputs: [arm], probability: 0.1}]";
    load(&format!(
        "{BASE}vary: {{senses: {{all: {{training.modality_dropout: {value}}}, one: {{input: [proprioception]}}}}}}\n"
    ));
}

#[test]
fn only_inputs_are_disturbed_by_what_they_can_have() {
    let runs = |text: &str| load(&format!("{BASE}{text}")).runs();
    let hash = |text: &str| runs(text)[0].hash();
    assert_eq!(hash("inputs: {arm: {noise: 0}}\n"), hash(""));
    assert_ne!(hash("inputs: {arm: {noise: 0.1}}\n"), hash(""));
    let run = runs("given: [without_each, {arm: {delay: 2, noise: 0.1}, proprioception: {}}]\n").remove(0);
    let names: Vec<&str> = run.given.iter().map(spec::Given::name).collect();
    assert_eq!(names, ["proprioception", "arm", "arm noise=0.1 delay=2,proprioception"]);
    // The order of elements has no meaning, and equal tests are made once.
    assert_eq!(hash("inputs: {arm: {only: [2, 0]}}\n"), hash("inputs: {arm: {only: [0, 2]}}\n"));
    let run = runs("given: [[arm], {arm: {}}, {arm: {only: [2, 0]}}, {arm: {only: [0, 2]}}]\n").remove(0);
    let names: Vec<&str> = run.given.iter().map(spec::Given::name).collect();
    assert_eq!(names, ["arm", "arm only=0+2"]);
    // A model of another program gets what was recorded.
    let external = runs("inputs: {arm: {noise: 0.1}}\ngiven: each\n").remove(0).external("other", "", 0);
    assert!(external.inputs.is_empty() && external.given.is_empty());
    // Runs without the input have no disturbance of it.
    let varied = "inputs: {arm: {noise: 0.1}}\nvary: {input: {without: each}}\n";
    let disturbed: Vec<usize> = runs(varied).iter().map(|run| run.inputs.len()).collect();
    assert_eq!(disturbed.iter().sum::<usize>() * 3, disturbed.len() * 2, "{disturbed:?}");
    let levels = runs("vary: {inputs.arm.noise: [0, 0.1]}\n");
    assert!(levels.iter().any(|run| run.variant == "arm.noise=0.1") && levels[0].inputs.is_empty());
    assert_refused(&[
        (
            "inputs: {contact_force: {noise: 0.1}}\n",
            "spec.yaml:7:25: unknown input 'contact_force'. Allowed: proprioception, arm; only inputs are disturbed",
        ),
        (
            "given: [{arm: {blur: 1}}]\n",
            "spec.yaml:7:22: 'arm' is a vector, which has no blur; use noise, bias, drift, delay, dropped, dead or only",
        ),
        ("given: [{}]\n", "spec.yaml:7:9: a network needs an input; name at least one"),
        (
            "inputs: {arm: {noise: -1}}\n",
            "spec.yaml:7:23: 'inputs.arm.noise': expected a finite number of at least 0 and at most 1000, found -1",
        ),
        (
            "inputs: {arm: {only: []}}\n",
            "spec.yaml:7:22: 'inputs.arm.only': expected a list of at least one item, each an integer of at \
             least 0, found an empty list",
        ),
        (
            "inputs: {arm: {lag: 1}}\n",
            "spec.yaml:7:16: unknown key 'lag' in 'inputs.arm'. Allowed: noise, bias, drift, delay, dropped, dead, \
             only, occlusion, blur",
        ),
    ]);
}

#[test]
fn null_patience_never_stops_early() {
    assert_eq!(load(BASE).training.patience, Some(20));
    assert_eq!(load(&format!("{BASE}training: {{patience: null}}")).training.patience, None);
}

#[test]
fn files_that_are_no_text_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let message = |path: &Path| spec::load(path, &[], false).unwrap_err().to_string();
    let missing = folder.path().join("none.yaml");
    assert_eq!(message(&missing), format!("{}: there is no such file", missing.display()));
    let directory = folder.path();
    assert_eq!(
        message(directory),
        format!("{}: is a directory; name a YAML file in it", directory.display())
    );
    assert_eq!(
        refusal(b"name: a\ndescription: \xff\n"),
        "spec.yaml: is not UTF-8 text: the first bad byte is on line 2"
    );
    assert_eq!(
        refusal("# a comment\n".repeat(100_000)),
        "spec.yaml: is larger than 1 MiB; it must be a short text"
    );
    for empty in ["", "\n\n", "# only a comment\n", "---\n"] {
        assert!(refusal(empty).ends_with("the file is empty; see `harness schema` for what a spec holds"));
    }
}

#[test]
fn broken_yaml_is_refused() {
    let cases = [
        ("name: [a", "spec.yaml:1:7: broken YAML: unclosed bracket '['"),
        ("name: a\nname: b\n", "spec.yaml:2:1: broken YAML: duplicate mapping key: name not allowed here"),
        (
            "name: a\n---\nname: b\n",
            "spec.yaml:3:1: broken YAML: only single YAML document expected but multiple found",
        ),
        ("name: *other\n", "spec.yaml:1:7: broken YAML: reference to unknown value"),
        ("just text\n", "spec.yaml:1:1: expected a section of keys, found the text 'just text'"),
        ("- a list\n", "spec.yaml:1:1: expected a section of keys, found a list of 1"),
    ];
    for (text, expected) in cases {
        assert_eq!(refusal(text), expected, "for {text:?}");
    }
}

#[test]
fn nested_aliases_and_deep_nesting_are_refused_at_once() {
    let mut bomb = String::from("a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n");
    for level in 1..10 {
        let alias = format!("*a{}", level - 1);
        bomb += &format!("a{level}: &a{level} [{}]\n", vec![alias; 10].join(", "));
    }
    let start = std::time::Instant::now();
    assert!(refusal(bomb).contains("broken YAML"));
    assert!(refusal("[".repeat(500_000)).contains("broken YAML"));
    assert!(refusal("a: ".repeat(1_000)).contains("broken YAML"));
    assert!(start.elapsed().as_secs() < 60);
}

#[test]
fn a_memory_needs_consecutive_samples() {
    let load = |overrides: &[&str]| load_with(BASE, overrides, false);
    let gru = ["network.memory=gru", "window.context=50"];
    let experiment = load(&[gru[0], gru[1], "window.start=rest", "window.horizon=3"]).unwrap();
    assert_eq!((experiment.network.memory, experiment.window.context), (Memory::Gru, 50));
    for (overrides, expected) in [
        (
            &gru[..1],
            "needs a context of several samples, or a horizon above 1; use for example window.context: 50, or",
        ),
        (&[gru[0], gru[1], "split.by=sample"], "which a split by sample tears apart; use episode or time"),
        (&[gru[0], gru[1], "split.by=time", "window.start=rest"], "leaves no whole episodes to start from"),
        (&[gru[0], gru[1], "training.burn_in=50"], "leaves nothing of a context of 50; use less"),
        (
            &["window.since_s=[2,20]"],
            "an episode lasts 20 s; use a shorter time or more actuations_per_episode",
        ),
    ] {
        let said = load(overrides).unwrap_err();
        assert!(said.contains(expected), "{said}");
    }
    // The memory then carries the state of the present sample forward.
    assert_eq!(load(&[gru[0], "window.horizon=3"]).unwrap().window.context, 1);
    // What is not said is not stored, so that runs without memory keep their names.
    let json = |overrides: &[&str]| serde_json::to_value(&load(overrides).unwrap().runs()[0]).unwrap();
    assert_eq!(json(&["network.memory=none", "window.start=random"]), json(&[]));
    assert_ne!(json(&gru), json(&gru[1..]));
    assert_eq!(
        json(&["training.discount=1", "training.burn_in=0", "training.truncate=null", "window.since_s=[]"]),
        json(&[])
    );
    // A sweep may compare contexts.
    let text = format!("{BASE}window: {{context: 5}}\nvary: {{window.context: [5, 50]}}\n");
    let swept = load_with(text, &gru[..1], false).unwrap();
    let mut contexts: Vec<usize> = swept.runs().iter().map(|run| run.window.context).collect();
    contexts.sort_unstable();
    contexts.dedup();
    assert_eq!(contexts, [5, 50]);
}

#[test]
fn unknown_keys_are_refused_with_the_nearest_name() {
    assert_refused(&[
        (
            "training:\n  bacth_size: 5\n",
            "spec.yaml:8:3: unknown key 'bacth_size' in 'training'; did you mean 'batch_size'? Allowed: \
             learning_rate, schedule, warmup_epochs, weight_decay, clip_norm, batch_size, \
             rollout_stride, discount, burn_in, truncate, epochs, last_epoch, patience, stop, kl_weight, predict, losses, \
             distributions, loss_weights, recalibration, dropout, modality_dropout, precision, tiles, device",
        ),
        (
            "split: {holdout: 0.1}\n",
            "spec.yaml:7:9: unknown key 'holdout' in 'split'. Allowed: by, validation, test, gap_seconds, folds, fold, seed",
        ),
        (
            "training: {loss_weights: {force: 2}}\n",
            "spec.yaml:7:34: 'force' is not an output; outputs: proprioception, contact_force",
        ),
        (
            "training: {losses: {vision: absolute}}\n",
            "spec.yaml:7:29: 'vision' is not an output; outputs: proprioception, contact_force",
        ),
        (
            "seed: 1\n",
            "spec.yaml:7:1: unknown key 'seed'; did you mean 'seeds'? Allowed: name, description, scenarios, \
             input, output, outputs, latent, seeds, tasks, action, window, network, simulation, split, test, inputs, \
             given, probes, scaling, training, vary, search, readings, quick",
        ),
    ]);
}

#[test]
fn unknown_names_are_refused_with_the_nearest_one() {
    let cases = [
        (
            "input: [proprioception, visoin]",
            "spec.yaml:3:25: unknown modality 'visoin' in 'input'; did you mean 'vision'? Allowed: \
             proprioception, arm, contact_force, contact_force_mean, contact_normal, vision, wrist, \
             frame_difference, wrist_difference",
        ),
        (
            "output: [optical_flow]",
            "spec.yaml:4:10: unknown modality 'optical_flow' in 'output'. Allowed: \
             proprioception, arm, contact_force, contact_force_mean, contact_normal, vision, wrist, \
             frame_difference, wrist_difference",
        ),
        (
            "scenarios: [clutter]",
            "spec.yaml:2:13: unknown scenario 'clutter' in 'scenarios'; did you mean 'cluttered'? Allowed: \
             empty, cluttered, crowded, crowded_moving, wrist, tendon, the path of a world file, or the name of an \
             imported dataset",
        ),
        (
            "network: {preset: Single_To_Multi}",
            "spec.yaml:6:19: unknown preset 'Single_To_Multi' in 'network.preset'; \
             did you mean 'single_to_multi'? Allowed: single_to_multi, multi_to_multi",
        ),
    ];
    for (line, expected) in cases {
        assert_eq!(refusal(base_with(line)), expected);
    }
    assert_refused(&[
        (
            "tasks: [predict]\n",
            "spec.yaml:7:9: unknown task 'predict' in 'tasks'. Allowed: prediction, reconstruction",
        ),
        ("action: 3\n", "spec.yaml:7:9: 'action': expected one of increment, target, found 3"),
    ]);
}

#[test]
fn missing_keys_are_named_together() {
    assert_eq!(
        refusal("name: a\nlatent: [2]\n"),
        "spec.yaml:1:1: missing 'scenarios', 'input', 'output', 'network'"
    );
    assert_eq!(refusal(base_with("network: {hidden: 8}")), "spec.yaml:6:10: missing 'network.preset'");
}

#[test]
fn wrong_types_and_values_out_of_bounds_are_refused() {
    assert_refused(&[
        (
            "training:\n  epochs: ten\n",
            "spec.yaml:8:11: 'training.epochs': expected an integer of at least 1 and at most 100000, \
             found the text 'ten'",
        ),
        (
            "training: {batch_size: 0}\n",
            "spec.yaml:7:24: 'training.batch_size': expected an integer of at least 1 and at most 65536, found 0",
        ),
        (
            "training: {batch_size: 2.5}\n",
            "spec.yaml:7:24: 'training.batch_size': expected an integer of at least 1 and at most 65536, \
             found 2.5",
        ),
        (
            "training: {epochs: 0}\n",
            "spec.yaml:7:20: 'training.epochs': expected an integer of at least 1 and at most 100000, found 0",
        ),
        (
            "training: {patience: 0}\n",
            "spec.yaml:7:22: 'training.patience': expected an integer of at least 1 and at most 100000 or null, \
             found 0",
        ),
        (
            "training: {learning_rate: 0}\n",
            "spec.yaml:7:27: 'training.learning_rate': expected a finite number above 0 and at most 1, found 0",
        ),
        (
            "training: {learning_rate: .nan}\n",
            "spec.yaml:7:27: 'training.learning_rate': expected a finite number above 0 and at most 1, \
             found NaN",
        ),
        (
            "training: {learning_rate: 1e999}\n",
            "spec.yaml:7:27: 'training.learning_rate': expected a finite number above 0 and at most 1, \
             found inf",
        ),
        (
            "training: {kl_weight: -1}\n",
            "spec.yaml:7:23: 'training.kl_weight': expected a finite number of at least 0 and at most 1000000, \
             found -1",
        ),
        (
            "training: {loss_weights: {contact_force: -1}}\n",
            "spec.yaml:7:42: 'training.loss_weights.contact_force': expected a finite number of at least 0 \
             and at most 1000000, found -1",
        ),
        ("training:\n", "spec.yaml:7:9: 'training': expected a section of keys, found nothing"),
        (
            "simulation: {episodes: 0}\n",
            "spec.yaml:7:24: 'simulation.episodes': expected an integer of at least 1 and at most 1000000, \
             found 0",
        ),
        (
            "simulation: {lift_range_m: [-1, 0, 1]}\n",
            "spec.yaml:7:28: 'simulation.lift_range_m': expected a list of 2 items, each a finite number, \
             found a list of 3",
        ),
        (
            "simulation: {lift_range_m: [-.inf, 0]}\n",
            "spec.yaml:7:29: 'simulation.lift_range_m': expected a finite number, found -inf",
        ),
        (
            "split: {test: 1.0}\n",
            "spec.yaml:7:15: 'split.test': expected a finite number above 0 and below 1 or a list of at least one item, each a text or a finite number, found 1.0",
        ),
        (
            "seeds: [-1]\n",
            "spec.yaml:7:9: 'seeds': expected an integer of at least 0 and at most 9007199254740991, found -1",
        ),
        (
            "seeds: [18446744073709551616]\n",
            "spec.yaml:7:9: 'seeds': expected an integer of at least 0 and at most 9007199254740991, \
             found 1.8446744073709552e19",
        ),
        (
            "tasks: []\n",
            "spec.yaml:7:8: 'tasks': expected a list of at least one item, each one of prediction, \
             reconstruction, found an empty list",
        ),
        (
            "description: 2024\n",
            "spec.yaml:7:14: 'description': expected a text, found 2024; \
             put a text that looks like something else in quotes",
        ),
    ]);
    let cases = [
        (
            "latent: [2, 0]",
            "spec.yaml:5:13: 'latent': expected an integer of at least 1 and at most 4096, found 0",
        ),
        (
            "latent: [5000]",
            "spec.yaml:5:10: 'latent': expected an integer of at least 1 and at most 4096, found 5000",
        ),
        (
            "latent: sixteen",
            "spec.yaml:5:9: 'latent': expected a list of at least one item, each an integer of at least 1 and \
             at most 4096, found the text 'sixteen'",
        ),
        ("latent: 0", "spec.yaml:5:9: 'latent': expected an integer of at least 1 and at most 4096, found 0"),
        (
            "network: {preset: single_to_multi, hidden: [1000000]}",
            "spec.yaml:6:45: 'network.hidden': expected an integer of at least 1 and at most 16384, found 1000000",
        ),
        ("input: [arm, vision, arm]", "spec.yaml:3:22: \"arm\" is in 'input' twice"),
        ("latent: [2, 4, 2]", "spec.yaml:5:16: 2 is in 'latent' twice"),
    ];
    for (line, expected) in cases {
        assert_eq!(refusal(base_with(line)), expected);
    }
}

#[test]
fn an_alias_is_blamed_where_it_is_used() {
    let text = format!("{BASE}split: {{test: &share 0.2}}\ntraining: {{batch_size: *share}}\n");
    assert!(refusal(text).starts_with("spec.yaml:8:24: 'training.batch_size': "));
}

#[test]
fn names_that_are_no_folder_names_are_refused() {
    let long = "a".repeat(65);
    for name in ["''", "a/b", "..", "a b", "é", "'a\n\n  b'", long.as_str()] {
        let message = refusal(base_with(&format!("name: {name}")));
        assert!(message.starts_with("spec.yaml:1:7: '"), "{message}");
        assert!(message.ends_with("use 1 to 64 ASCII letters, digits, '_' and '-'"), "{message}");
        assert!(!message.contains('\n'), "{message}");
    }
    assert_eq!(load(&base_with(&format!("name: {}", &long[1..]))).name, &long[1..]);
}

#[test]
fn frames_need_convolutions_that_fit_them() {
    for (line, position, frame) in [
        ("input: [arm, vision]", "3:14", "vision"),
        ("output: [frame_difference]", "4:10", "frame_difference"),
    ] {
        assert_eq!(
            refusal(base_with(line)),
            format!(
                "spec.yaml:{position}: '{frame}' is an image, and a single_to_multi network takes vectors alone; \
                 leave it out, use network.preset: multi_to_multi, or give it convolutions by network.channels"
            )
        );
    }
    let without = base_with("network: {preset: multi_to_multi, channels: []}");
    assert_eq!(
        refusal(without.replace("input: [proprioception, arm]", "input: [vision]")),
        "spec.yaml:3:9: 'vision' is an image, and a network without channels takes vectors alone; leave it out, or \
         give it convolutions by network.channels"
    );
    let seeing = |network: &str| {
        let text = base_with(&format!("network: {network}"));
        text.replace("input: [proprioception, arm]", "input: [vision]")
    };
    for network in [
        "{preset: multi_to_multi}",
        "{preset: single_to_multi, channels: [4]}",
        "{preset: multi_to_multi, channels: [8, 16, 32, 32, 8, 4]}",
        "{preset: multi_to_multi, channels: [8, 16], average: 16, hidden: [64, 32], fusion: late}",
    ] {
        load(&seeing(network));
    }
    assert_eq!(
        refusal(seeing("{preset: multi_to_multi, channels: [8, 8, 8], average: 16}")),
        "spec.yaml:6:45: 3 convolutions halve the side of an image as often, and it has 4 pixels after averaging; \
         give 2 channels at most"
    );
    assert_eq!(
        refusal(seeing("{preset: multi_to_multi, average: 3}")),
        "spec.yaml:6:44: images of 64 x 64 pixels can't be divided into squares of 3 x 3"
    );
}

#[test]
fn a_network_without_frames_has_no_convolutions() {
    // The preset's name, and settings without an effect, do not change the layers.
    let vectors = load(BASE).network;
    let other = load(&base_with("network: {preset: single_to_multi, channels: [8, 16], average: 4}")).network;
    assert_eq!(vectors, other);
}

#[test]
fn rules_that_tie_settings_together_are_checked() {
    assert_refused(&[
        (
            "tasks: [reconstruction]\n",
            "spec.yaml:7:9: reconstruction uses the encoder that prediction trains; put prediction before it",
        ),
        (
            "tasks: [reconstruction, prediction]\n",
            "spec.yaml:7:9: reconstruction uses the encoder that prediction trains; put prediction before it",
        ),
        (
            "training: {epochs: 5, warmup_epochs: 5.5}\n",
            "spec.yaml:7:38: 5.5 epochs of warm-up don't fit into training.epochs, 5; use fewer",
        ),
        (
            "training: {learning_rate: 0.01, weight_decay: 101}\n",
            "spec.yaml:7:47: a step takes learning_rate times weight_decay of each weight away, here more than all \
             of it; use 100 at most",
        ),
        (
            "training: {device: cuda, precision: bf16}\n",
            "spec.yaml:7:37: bf16 is for the cpu; a network on cuda is trained in f32 or tf32",
        ),
        (
            "training: {precision: tf32}\n",
            "spec.yaml:7:23: tf32 is for cuda; a network on the cpu is trained in f32 or bf16",
        ),
        (
            "training: {loss_weights: {vision: 1}}\n",
            "spec.yaml:7:35: 'vision' is not an output; outputs: proprioception, contact_force",
        ),
        (
            "training: {losses: {arm: huber}}\n",
            "spec.yaml:7:26: 'arm' is not an output; outputs: proprioception, contact_force",
        ),
        (
            "training: {loss_weights: {proprioception: 0, contact_force: 0}}\n",
            "spec.yaml:7:26: every output has weight 0, so there is nothing to learn",
        ),
        (
            "simulation:\n  extension_range_m: [1.5, 0]\n",
            "spec.yaml:8:22: the range [1.5, 0] is reversed; write [0, 1.5]",
        ),
        (
            "simulation: {sample_rate_hz: 30}\n",
            "spec.yaml:7:30: 30 Hz does not divide the simulation's 1000 Hz; use one that does, \
             such as 10, 20, 50, 100",
        ),
        (
            "simulation: {actuation_seconds: 0.25}\n",
            "spec.yaml:7:33: 0.25 s is not a whole number of samples at 10 Hz; use a multiple of 0.1 s",
        ),
        (
            "simulation: {seed: 1, sample_rate_hz: 2.5}\n",
            "spec.yaml:7:39: simulation.actuation_seconds: 1 s is not a whole number of samples at 2.5 Hz; use a \
             multiple of 0.4 s",
        ),
        (
            "simulation: {actuation_seconds: 0.1, actuations_per_episode: 1}\n",
            "spec.yaml:7:62: an episode of one sample has no next observation to predict; use at least 2 samples",
        ),
        (
            "simulation: {episodes: 1000000, actuations_per_episode: 1000}\n",
            "spec.yaml:7:24: 10000000000 samples a scenario are more than the 100000000 that are allowed; \
             use fewer or shorter episodes",
        ),
        (
            "split: {validation: 0.6, test: 0.4}\n",
            "spec.yaml:7:8: validation 0.6 and test 0.4 of 200 episodes leave none for training; \
             use smaller shares or more episodes",
        ),
        (
            "window: {context: 150, horizon: 60}\n",
            "spec.yaml:7:19: a window of 150 and 60 samples does not fit into an episode of 200; use a shorter window \
             or more actuations_per_episode",
        ),
        (
            "window: {horizon: 2}\n",
            "spec.yaml:7:19: a network without memory predicts further than one sample from its own predictions, and \
             these lack its input 'arm'; add it to the output, or use network.memory or horizon: 1",
        ),
        (
            "split: {by: sample, validation: 0.6, test: 0.4}\n",
            "spec.yaml:7:8: validation 0.6 and test 0.4 of 39800 windows leave none for training; \
             use smaller shares or more samples",
        ),
        (
            "split: {by: time, gap_seconds: 8}\n",
            "spec.yaml:7:8: validation 0.1, test 0.1 and two gaps of 8 s leave nothing of an episode of 20 s for \
             training; use smaller shares, a smaller gap_seconds or more actuations_per_episode",
        ),
        (
            "split: {gap_seconds: 2}\n",
            "spec.yaml:7:22: a split by episode has no gap; leave it out, or use split.by: time",
        ),
        (
            "simulation: {actuations_per_episode: 4000, episodes: 1}\n",
            "spec.yaml:7:54: a split by episode needs at least 3 episodes, one each for training, validation and \
             test, found 1; use more, or split.by: time, which divides each episode",
        ),
        (
            "scaling: {vision: {scale: per_element}}\n",
            "spec.yaml:7:27: 'vision' is an image, whose values share one standard deviation; use shared",
        ),
    ]);
    // Two worlds have the same modalities.
    let unknown = refusal(format!("{BASE}scaling: {{force: {{scale: shared}}}}\n"));
    assert!(unknown.contains("unknown key 'force' in 'scaling'"), "{unknown}");
    assert_eq!(unknown.matches("proprioception").count(), 1, "{unknown}");
    let wide = "name: wide\nscenarios: [empty]\ninput: [vision]\noutput: [arm]\nlatent: [2]\n";
    assert_eq!(
        refusal(format!("{wide}network:\n  preset: multi_to_multi\n  channels: [256]\n  hidden: [2048]\n")),
        "spec.yaml:9:11: a tensor of the network would pass 1 GiB: with 262144 values behind the convolutions, \
         'network.hidden' can be 1024 at most, found 2048"
    );
}

#[test]
fn shares_become_whole_episodes_of_each_kind() {
    let counts =
        |episodes| Split { validation: 0.1, test: 0.2.into(), ..Split::default() }.counts(episodes, false);
    assert_eq!(counts(40), Some(SplitCounts { training: 28, validation: 4, test: 8 }));
    assert_eq!(counts(3), Some(SplitCounts { training: 1, validation: 1, test: 1 }));
    assert_eq!(counts(2), None);
}

#[test]
fn a_continuous_run_is_allowed_where_time_or_samples_are_split() {
    let run = format!("{BASE}simulation: {{episodes: 1, actuations_per_episode: 4000}}\n");
    for by in [Division::Time, Division::Sample] {
        let experiment = load(&format!("{run}split: {{by: {by}}}\n"));
        assert_eq!(experiment.simulation.samples_per_episode(), 40_000);
        assert_eq!(experiment.split.by, by);
        assert_eq!(experiment.split.gap_seconds, (by == Division::Time).then_some(5.0));
    }
}

#[test]
fn what_a_spec_says_of_a_scaling_replaces_that_default_alone() {
    let scaling = |addition: &str| load(&format!("{BASE}{addition}")).runs()[0].scaling.clone();
    let shared = |minimum| Scaling { scale: Scale::Shared, minimum };
    let each = Scaling { scale: Scale::PerElement, minimum: None };
    let default = [
        (Modality::PROPRIOCEPTION, each),
        (Modality::ARM, each),
        (Modality::CONTACT_FORCE, shared(Some(0.0))),
    ];
    assert_eq!(scaling(""), Scalings::from(default));
    let given = scaling("scaling: {contact_force: {minimum: null}, arm: {minimum: -2, scale: shared}}");
    let expected = [(Modality::CONTACT_FORCE, shared(None)), (Modality::ARM, shared(Some(-2.0)))];
    assert_eq!(given, default.into_iter().chain(expected).collect());
    let text = format!("{BASE}vary:\n  scaling.contact_force.scale: [shared, per_element]\n");
    let runs = load(&text).runs();
    assert_eq!(runs[2].variant, "contact_force.scale=per_element");
    assert_eq!(runs[2].scalings(&Layout::finger())[&Modality::CONTACT_FORCE].scale, Scale::PerElement);
}

/// A run's spec contains the scaling of the modalities that it uses, except where it is the scaling of earlier
/// versions.
#[test]
fn a_run_that_is_scaled_as_runs_were_before_keeps_its_hash() {
    let run = |addition: &str| load(&format!("{BASE}{addition}")).runs().remove(0);
    let stated: Vec<Modality> = run("").scaling.into_keys().collect();
    assert_eq!(stated, [Modality::PROPRIOCEPTION, Modality::ARM, Modality::CONTACT_FORCE]);
    let plain = run("scaling: {contact_force: {scale: per_element, minimum: null}, vision: {minimum: 0}}\n\
                     simulation: {episodes: 40, actuations_per_episode: 100}\n");
    assert_eq!(plain.scaling, Scalings::new());
    assert_eq!(plain.scalings(&Layout::finger())[&Modality::CONTACT_FORCE], Scaling::plain(false));
    // This is the spec's hash from before `scaling` and `split.by` were settings.
    assert_eq!(plain.hash(), "3878ffe86883afc2");
}

#[test]
fn a_test_with_a_dataset_of_its_own_is_part_of_what_names_a_run() {
    let run = |addition: &str| load(&format!("{BASE}{addition}")).runs().remove(0);
    let tested = run("test: {}\n");
    assert_eq!(tested.test.as_ref().map(|test| (test.episodes, test.seed)), Some((200, 0)));
    let simulation = tested.test_simulation().unwrap();
    assert_eq!(Simulation { test: false, ..simulation.clone() }, tested.simulation.clone().unwrap());
    assert!(simulation.test);
    let names = |run: &spec::RunSpec| (run.hash(), run.task_hash("dataset"));
    let others = [run(""), run("test: {episodes: 20}\n"), run("test: {seed: 1}\n")];
    for other in &others {
        assert_ne!(names(other), names(&tested));
    }
    assert_eq!(run("test: {}\nsplit: {test: 0.3}\n"), tested, "split.test has no effect");
    assert_eq!(serde_yaml::from_str::<spec::RunSpec>(&tested.to_yaml()).unwrap(), tested);
    assert_eq!(load(&tested.to_experiment_yaml("again")).runs(), [tested]);
    // Runs on other data are tested on the same episodes.
    let text = format!(
        "{BASE}test: {{episodes: 50, seed: 3}}\nquick: {{test.episodes: 20}}\n\
         vary: {{simulation.seed: [0, 3], simulation.episodes: [20, 40]}}\n"
    );
    let of = |quick| load_with(&text, &[], quick).unwrap().simulated();
    for (quick, episodes) in [(false, 50), (true, 20)] {
        let tests: Vec<Simulation> =
            of(quick).into_iter().map(|(_, one)| one).filter(|one| one.test).collect();
        assert!(tests.iter().all(|test| (test.seed, test.episodes) == (3, episodes)));
        assert_eq!((of(quick).len(), tests.len()), (10, 2), "in each of two worlds");
    }
}

#[test]
fn a_test_that_can_have_no_dataset_of_its_own_is_refused() {
    let refused = [
        (
            &["test.episodes=9", "split.by=time"][..],
            "a split by time takes the test from each episode of the run's own",
        ),
        (
            &["test.episodes=9", "split.by=sample"],
            "a split by sample takes the test from each episode of the run's own",
        ),
        (
            &["test.episodes=9", "scenarios=[lab-0123456789abcdef]"],
            "is imported, so no episodes can be simulated",
        ),
        (&["test.episodes=9", "simulation.episodes=1"], "leaves none for training"),
        (&["test.dataset=x"], "test.dataset"),
        (&["test.dataset=lab-0123456789abcdef"], "'empty' is simulated, and so is its test"),
        (
            &["test.dataset=lab-0123456789abcdef", "scenarios=[lab-0123456789abcdef]"],
            "'lab-0123456789abcdef' would be for training and for the test",
        ),
        (
            &["test.dataset=day-0123456789abcdef", "test.seed=1", "scenarios=[lab-0123456789abcdef]"],
            "has episodes of its own; leave out test.episodes and test.seed",
        ),
        (&["test.episodes=0"], "1"),
        (&["simulation.test=true"], "simulation.test"),
        (&["simulation.seed=9007199254740992"], "9007199254740991"),
    ];
    for (overrides, expected) in refused {
        let said = load_with(BASE, overrides, false).unwrap_err();
        assert!(said.contains(expected), "{overrides:?}: {said}");
    }
    assert_eq!(
        load_with(BASE, &["test.episodes=9", "simulation.episodes=2"], false).unwrap().simulation.episodes,
        2
    );
}

#[test]
fn timing_in_samples_and_steps() {
    let simulation = load(BASE).simulation;
    assert_eq!(simulation.samples_per_actuation(), 10);
    assert_eq!(simulation.samples_per_episode() * simulation.episodes as usize, 40_000);
    let text = format!("{BASE}simulation: {{sample_rate_hz: 100, actuation_seconds: 0.07}}");
    assert_eq!(load(&text).simulation.samples_per_actuation(), 7);
}

#[test]
fn overrides_replace_single_settings() {
    let overrides = [
        "training.batch_size=512",
        "latent=[8, 16]",
        "training.loss_weights.contact_force=2",
        "training.patience=null",
        "description=a: b=c",
        "training.batch_size=256",
    ];
    // The value of `description` is parsed as YAML, in which `a: b=c` is a section.
    assert_eq!(
        load_with(BASE, &overrides, false).unwrap_err(),
        "override 'description=a: b=c': 'description': expected a text, found a section of keys; \
         put a text that looks like something else in quotes"
    );
    let overrides =
        overrides.map(|text| if text.starts_with("desc") { "description='a: b=c'" } else { text });
    let mut expected = load(BASE);
    expected.training.batch_size = 256;
    expected.training.patience = None;
    expected.training.loss_weights.insert(Modality::CONTACT_FORCE, 2.0);
    expected.latent = vec![8, 16];
    expected.description = "a: b=c".into();
    assert_eq!(load_with(BASE, &overrides, false).unwrap(), expected);
}

#[test]
fn a_list_replaces_the_values_of_a_varied_setting() {
    let varied = |axis: &str| format!("{BASE}vary:\n  {axis}\n");
    let epochs = varied("training.epochs: [1, 2, 3]");
    let expected = load(&varied("training.epochs: [7, 9]"));
    assert_eq!(load_with(&epochs, &["training.epochs=[7, 9]"], false).unwrap(), expected);
    // A value that is a list itself is one value.
    let hidden =
        load_with(varied("network.hidden: [[8], [9]]"), &["network.hidden=[64, 32]"], false).unwrap();
    assert!(hidden.runs().iter().all(|run| run.trained().unwrap().network.hidden == [64, 32]));
}

#[test]
fn a_single_value_stands_for_a_list_of_one() {
    let list =
        base_with("latent: [2]") + "tasks: [prediction]\nvary:\n  training.epochs: [5]\n  output: [[arm]]\n";
    let single = base_with("latent: 2") + "tasks: prediction\nvary:\n  training.epochs: 5\n  output: arm\n";
    assert_eq!(load(&single), load(&list));
    let settings = ["seeds", "scenarios", "output", "vary"];
    let lists = ["[7]", "[empty]", "[arm]", "{training.patience: [null]}"];
    let singles = ["7", "empty", "arm", "{training.patience: null}"];
    let given = |values: [&str; 4]| {
        let overrides: Vec<String> =
            settings.iter().zip(values).map(|(key, value)| format!("{key}={value}")).collect();
        load_with(BASE, &overrides.iter().map(String::as_str).collect::<Vec<_>>(), false).unwrap()
    };
    assert_eq!(given(singles), given(lists));
    let quick = |value| load_with(format!("{BASE}quick:\n  seeds: {value}\n"), &[], true).unwrap();
    assert_eq!(quick("7"), quick("[7]"));
    // A pair can't be replaced by a single value, and null is not a value.
    assert!(override_refusal("simulation.lift_range_m=0").contains("expected a list of 2 items"));
    assert!(override_refusal("seeds=null").contains("expected a list of at least one item"));
}

#[test]
fn bad_overrides_are_refused_by_name() {
    let cases = [
        (
            "training.epochs=ten",
            "override 'training.epochs=ten': 'training.epochs': expected an integer of at least 1 and at most \
             100000, found the text 'ten'",
        ),
        (
            "training.epochs",
            "override 'training.epochs': has no '='; write KEY=VALUE, as in training.epochs=3",
        ),
        (
            "split.tset=0.2",
            "override 'split.tset=0.2': unknown key 'split.tset'; did you mean 'split.test=0.2'? \
             Allowed: split.by, split.validation, split.test, split.gap_seconds, split.folds, split.fold, split.seed",
        ),
        (
            "split={test: 0.2}",
            "override 'split={test: 0.2}': 'split' is a section; override its keys one by one: \
             split.by, split.validation, split.test, split.gap_seconds, split.folds, split.fold, split.seed",
        ),
        ("latent=[8", "override 'latent=[8': broken YAML: unclosed bracket '['"),
        (
            "latent=",
            "override 'latent=': 'latent': expected a list of at least one item, each an integer of at least 1 \
             and at most 4096, found nothing",
        ),
        (
            "input=[vision]",
            "override 'input=[vision]': 'vision' is an image, and a single_to_multi network takes vectors alone; \
             leave it out, use network.preset: multi_to_multi, or give it convolutions by network.channels",
        ),
        (
            "simulation.lift_range_m=[0, -1]",
            "override 'simulation.lift_range_m=[0, -1]': the range [0, -1] is reversed; write [-1, 0]",
        ),
    ];
    for (text, expected) in cases {
        assert_eq!(override_refusal(text), expected);
    }
    // All keys together are too many to list after a suggestion.
    assert_eq!(
        override_refusal("batch_size=512"),
        "override 'batch_size=512': unknown key 'batch_size'; did you mean 'training.batch_size=512'?"
    );
    for key in ["vary.senses", "vary.senses.a.action", "vary.training.epochs"] {
        assert_eq!(
            override_refusal(&format!("{key}=1")),
            format!(
                "override '{key}=1': '{key}' can't be set alone; give a whole axis, as in 'vary={{training.epochs: \
                 [5, 10]}}' or 'vary={{AXIS: {{LABEL: {{KEY: VALUE}}}}}}', or one value for all runs, as in \
                 training.epochs=5"
            )
        );
    }
    // An override has no lines, so its messages say which item of a list is at fault.
    for (text, expected) in [
        (
            "given=[[arm], [amr]]",
            "item 2: unknown input 'amr'; did you mean 'arm'? Allowed: proprioception, arm",
        ),
        ("latent=[8, 0]", "item 2: 'latent': expected an integer of at least 1 and at most 4096, found 0"),
        (
            "training.modality_dropout=[{inputs: [arm], probability: 0.1}, {inputs: [arm, amr], probability: 0.2}]",
            "item 2: item 2: unknown input 'amr'; did you mean 'arm'? Allowed: proprioception, arm",
        ),
    ] {
        let said = override_refusal(text);
        assert!(said.starts_with("override '") && said.ends_with(&format!("': {expected}")), "{said}");
    }
    let message = override_refusal("nonsense=512");
    assert!(message.contains("unknown key 'nonsense'. Allowed: name, description, "), "{message}");
    assert_eq!(
        override_refusal("latent=\"abc\""),
        "override 'latent=\"abc\"': 'latent': expected a list of at least one item, each an integer of at least 1 and \
         at most 4096, found the text 'abc'"
    );
    // Both keys differ from `seeds` by one letter. The suggestion must not be `simulation.seed`, which changes the
    // data.
    let long = format!("seed=[{}]", [7; 40].map(|seed| seed.to_string()).join(", "));
    for (text, suggestion) in [
        ("seed=7", "seeds=[7]"),
        ("seed=[7, 8]", "seeds=[7, 8]"),
        ("sees=7", "seeds=[7]"),
        // What is refused, too, or shortened is not suggested.
        ("seed=1e400", "seeds"),
        ("training.epoch=two", "training.epochs"),
        (&long, "seeds"),
    ] {
        let message = override_refusal(text);
        assert!(message.contains(&format!("; did you mean '{suggestion}'?")), "{message}");
    }
    assert!(override_refusal("quick={}").starts_with("override 'quick={}': unknown key 'quick'"));
}

#[test]
fn a_file_that_an_override_makes_impossible_is_blamed_with_it() {
    let text = format!("{BASE}training: {{loss_weights: {{contact_force: 2}}}}\n");
    assert_eq!(
        load_with(text, &["output=[arm]"], false).unwrap_err(),
        "spec.yaml:7:42: 'contact_force' is not an output; outputs: arm \
         (after applying the overrides)"
    );
}

#[test]
fn quick_settings_apply_when_asked_and_before_overrides() {
    let text = format!("{BASE}quick:\n  training.epochs: 5\n  simulation.episodes: 6\n");
    assert_eq!(load(&text), load(BASE));
    let mut expected = load(BASE);
    expected.name += "-quick";
    expected.training.epochs = 5;
    expected.simulation.episodes = 6;
    assert_eq!(load_with(&text, &[], true).unwrap(), expected);
    expected.training.epochs = 7;
    assert_eq!(load_with(&text, &["training.epochs=7"], true).unwrap(), expected);
}

#[test]
fn a_spec_without_quick_settings_has_no_quick_runs() {
    for text in [BASE.to_owned(), format!("{BASE}quick: {{}}\n")] {
        assert_eq!(
            load_with(&text, &["training.epochs=1"], true).unwrap_err(),
            "spec.yaml:1:1: there is no 'quick' section, so a quick run would be the full one under another name; \
             add the section, or leave out --quick"
        );
    }
}

#[test]
fn a_given_varied_setting_is_tried_with_that_value_alone() {
    let text = format!(
        "{}vary:\n  training.epochs: [1, 2]\n  training.kl_weight: [0, 1]\nquick:\n  training.epochs: 3\n",
        base_with("latent: [2]").replace("[empty, cluttered]", "[empty]")
    );
    let tried = |overrides: &[&str], quick| -> Vec<(usize, f64)> {
        let runs = load_with(&text, overrides, quick).unwrap().runs();
        let settings = runs
            .iter()
            .map(|run| (run.trained().unwrap().training.epochs, run.trained().unwrap().training.kl_weight))
            .collect();
        let named = |run: &spec::RunSpec| {
            format!(
                "epochs={},kl_weight={}",
                run.trained().unwrap().training.epochs,
                run.trained().unwrap().training.kl_weight
            )
        };
        assert!(runs.iter().all(|run| run.variant == named(run)), "{settings:?}");
        settings
    };
    assert_eq!(tried(&[], false), [(1, 0.0), (1, 1.0), (2, 0.0), (2, 1.0)]);
    assert_eq!(tried(&["training.epochs=5"], false), [(5, 0.0), (5, 1.0)]);
    assert_eq!(tried(&[], true), [(3, 0.0), (3, 1.0)]);
    assert_eq!(tried(&["training.epochs=5", "training.kl_weight=1"], true), [(5, 1.0)]);
    // The order of the overrides does not matter.
    let vary = "vary={training.epochs: [7, 8], training.kl_weight: [0]}";
    assert_eq!(tried(&[vary], true), [(7, 0.0), (8, 0.0)]);
    assert_eq!(tried(&["training.epochs=5", vary], false), tried(&[vary, "training.epochs=5"], false));
    assert_eq!(tried(&["training.epochs=5", vary], false), [(5, 0.0)]);
    let refused = load_with(&text, &["training.epochs=0"], false).unwrap_err();
    assert!(refused.starts_with("override 'training.epochs=0': "), "{refused}");
}

/// A sweep that is limited to one value has the same run as the whole sweep, so the run is not done again.
#[test]
fn a_given_value_that_the_spec_tries_gives_the_same_run() {
    let text = base_with("latent: [2]") + "vary:\n  training.epochs: [1, 2]\n";
    let all = load(&text).runs();
    let one = load_with(&text, &["training.epochs=2"], false).unwrap().runs();
    assert_eq!(one, [all[1].clone(), all[3].clone()]);
}

#[test]
fn other_files_of_the_harness_are_called_by_what_they_are() {
    for (text, expected) in [
        (
            load(BASE).runs()[0].to_yaml(),
            "this is the spec of one run, not an experiment; `harness show RUN`",
        ),
        (
            include_str!("../models/empty.yaml").to_owned(),
            "this is a world, not an experiment; give its path in",
        ),
    ] {
        let message = refusal(text);
        assert!(message.contains(expected), "{message}");
    }
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str, text: &str| {
        let path = folder.path().join(name);
        fs::write(&path, text).unwrap();
        path
    };
    let (mapping, claims) = ("name: a\nsource: b\nmodalities: {setpoint: none}\n", "claims: []\n");
    for (text, is) in
        [(BASE, "an experiment"), (mapping, "a mapping of a recording"), (claims, "a file of claims")]
    {
        let said = World::load(&path("a.yaml", text)).unwrap_err().to_string();
        assert!(said.contains(&format!("this is {is}, not a world; ")), "{said}");
    }
    let said = read_mapping(&path("a.yaml", include_str!("../models/empty.yaml"))).unwrap_err().to_string();
    assert!(said.contains("this is a world, not a mapping of a recording; "), "{said}");
}

#[test]
fn quick_settings_are_checked_even_when_not_applied() {
    assert_refused(&[
        (
            "quick:\n  split.tets: 0.3\n",
            "spec.yaml:8:3: unknown key 'split.tets' in 'quick'; did you mean 'split.test'? \
             Allowed: split.by, split.validation, split.test, split.gap_seconds, split.folds, split.fold, split.seed",
        ),
        (
            "quick:\n  training.epochs: 0\n",
            "spec.yaml:8:20: 'quick.training.epochs': expected an integer of at least 1 and at most 100000, found 0",
        ),
        (
            "quick:\n  input: [vision]\n",
            "spec.yaml:8:11: 'vision' is an image, and a single_to_multi network takes vectors alone; leave it out, \
             use network.preset: multi_to_multi, or give it convolutions by network.channels (after applying 'quick')",
        ),
    ]);
}

#[test]
fn runs_expand_by_scenario_then_latent_then_seed() {
    let runs = load(&format!("{BASE}seeds: [7, 3]\n")).runs();
    let labels: Vec<String> = runs.iter().map(|run| run.label()).collect();
    assert_eq!(
        labels,
        [
            "empty-z2-seed7",
            "empty-z2-seed3",
            "empty-z4-seed7",
            "empty-z4-seed3",
            "cluttered-z2-seed7",
            "cluttered-z2-seed3",
            "cluttered-z4-seed7",
            "cluttered-z4-seed3",
        ]
    );
    assert_eq!(runs[6].cell(), "cluttered-z4");
}

#[test]
fn an_imported_dataset_is_named_where_a_scenario_is() {
    const NAME: &str = "lab_finger-0123456789abcdef";
    let text = BASE.replace("[empty, cluttered]", &format!("[cluttered, {NAME}]"));
    let experiment = load(&text);
    assert_eq!(experiment.scenarios, [Scenario::CLUTTERED.into(), Origin::Imported(NAME.to_owned())]);
    assert_eq!(load(&experiment.to_yaml()), experiment);
    let runs = experiment.runs();
    assert_eq!(runs[2].label(), format!("{NAME}-z2-seed0"));
    assert_eq!(runs[0].simulation.as_ref(), Some(&experiment.simulation));
    assert_eq!(runs[2].simulation, None, "nothing is simulated");
    let json = serde_json::to_string(&runs[2]).unwrap();
    assert_eq!(serde_json::from_str::<spec::RunSpec>(&json).unwrap(), runs[2]);
    assert!(!json.contains("actuation"), "{json}");
}

#[test]
fn splits_of_imported_datasets_do_not_depend_on_the_simulation() {
    let spec = |scenario: &str| {
        let text = BASE.replace("[empty, cluttered]", scenario);
        format!(
            "{text}simulation: {{actuations_per_episode: 7}}\nsplit: {{by: time}}\nwindow: {{context: 60}}\n"
        )
    };
    load(&spec("[lab_finger-0123456789abcdef]"));
    assert!(refusal(spec("[empty]")).contains("leave nothing of an episode of"));
}

#[test]
fn horizons_and_folds_in_a_list_make_runs() {
    let imported = BASE.replace("[empty, cluttered]", "lab-0123456789abcdef").replace("[2, 4]", "2");
    let text = imported.replace("output: [proprioception, ", "output: [");
    let horizons = |overrides: &[&str]| -> Vec<usize> {
        let text = format!("{text}window: {{horizon: [0, 1]}}\n");
        load_with(text, overrides, false).unwrap().runs().iter().map(|run| run.window.horizon).collect()
    };
    assert_eq!(horizons(&[]), [0, 1]);
    assert_eq!(horizons(&["window.horizon=0"]), [0]);
    assert_eq!(horizons(&["window.horizon=[1, 0]"]), [1, 0]);
    let folds = load(&format!("{imported}split: {{by: object, folds: 3}}\n"));
    let runs = folds.runs();
    assert_eq!(
        runs.iter().map(spec::RunSpec::label).collect::<Vec<_>>(),
        [
            "lab-0123456789abcdef-z2-seed0",
            "lab-0123456789abcdef-z2-data1-seed0",
            "lab-0123456789abcdef-z2-data2-seed0",
        ]
    );
    assert_eq!(load(&folds.to_yaml()), folds);
    let json = serde_json::to_string(&runs[2]).unwrap();
    assert_eq!(serde_json::from_str::<spec::RunSpec>(&json).unwrap(), runs[2]);
    for (addition, expected) in [
        ("window: {horizon: 0}\n", "with window.horizon: 0, the output 'proprioception' is estimated at"),
        ("split: {by: object}\n", "unknown division 'object' in 'split.by'"),
        ("split: {folds: 3}\n", "folds are for recordings"),
    ] {
        let error = refusal(format!("{BASE}{addition}"));
        assert!(error.contains(expected), "{error}");
    }
    let error = refusal(format!("{imported}split: {{by: time, folds: 3}}\n"));
    assert!(error.contains("a split by time has no groups"), "{error}");
}

#[test]
fn what_no_imported_dataset_can_be_called_is_no_scenario() {
    let too_long = format!("{}-0123456789abcdef", "a".repeat(65));
    for name in [
        "lab_finger",
        "lab_finger-0123456789abcde",
        "lab_finger-0123456789abcdeF",
        "lab-finger-0123456789abcdef",
        "9finger-0123456789abcdef",
        "-0123456789abcdef",
        "empty-0123456789abcdef",
        &too_long,
    ] {
        let said = refusal(base_with(&format!("scenarios: ['{name}']")));
        assert!(
            said.starts_with("spec.yaml:2:13: unknown scenario '") && said.contains("imported"),
            "{said}"
        );
    }
}

#[test]
fn runs_expand_by_every_combination_of_what_varies() {
    let vary = "vary:\n  training.kl_weight: [0, 0.01]\n  action: [target]\n  \
                training.loss_weights.contact_force: [2.5]\n";
    let text = format!("{}{vary}", base_with("latent: [2]"));
    let runs = load(&text).runs();
    let labels: Vec<String> = runs.iter().map(|run| run.label()).collect();
    assert_eq!(
        labels,
        [
            "empty-z2-action=target,kl_weight=0,loss_weights.contact_force=2.5-seed0",
            "empty-z2-action=target,kl_weight=0.01,loss_weights.contact_force=2.5-seed0",
            "cluttered-z2-action=target,kl_weight=0,loss_weights.contact_force=2.5-seed0",
            "cluttered-z2-action=target,kl_weight=0.01,loss_weights.contact_force=2.5-seed0",
        ]
    );
    let run = &runs[3];
    assert_eq!((run.trained().unwrap().training.kl_weight, run.action), (0.01, Action::Target));
    assert_eq!(run.trained().unwrap().training.loss_weights[&Modality::CONTACT_FORCE], 2.5);
    assert_eq!(run.trained().unwrap().training.loss_weights[&Modality::PROPRIOCEPTION], 1.0);
}

#[test]
fn what_varies_may_change_the_modalities() {
    let text =
        base_with("output: [proprioception]") + "vary:\n  output: [[proprioception], [contact_force, arm]]\n";
    let runs = load(&text).runs();
    assert_eq!(runs[2].variant, "output=contact_force+arm");
    assert_eq!(runs[2].output, [Modality::ARM, Modality::CONTACT_FORCE]);
    let weights: Vec<_> = runs[2].trained().unwrap().training.loss_weights.keys().copied().collect();
    assert_eq!(weights, [Modality::ARM, Modality::CONTACT_FORCE]);
}

#[test]
fn each_combination_of_what_varies_must_be_possible() {
    assert_refused(&[
        (
            "vary:\n  simulation.seeds: [0, 1]\n",
            "spec.yaml:8:3: unknown key 'simulation.seeds' in 'vary'; did you mean 'simulation.seed'? Allowed: \
             simulation.seed, simulation.episodes, simulation.actuations_per_episode, simulation.actuation_seconds, \
             simulation.sample_rate_hz, simulation.factors, simulation.policy, simulation.rotation_range_rad, \
             simulation.lift_range_m, simulation.extension_range_m, simulation.box_clearance_m, \
             simulation.pillar_clearance_m, simulation.front_range_n, simulation.back_range_n, \
             simulation.left_range_n, simulation.right_range_n",
        ),
        (
            "vary:\n  seeds: [0, 1]\n",
            "spec.yaml:8:3: 'seeds' is a list already; leave it out of 'vary', and write seeds: [0,1] at the top level \
             of the spec",
        ),
        (
            "vary:\n  training.epochs: [5, 0]\n",
            "spec.yaml:8:24: 'vary.training.epochs': expected an integer of at least 1 and at most 100000, found 0",
        ),
        (
            "vary:\n  input: [[arm], [vision]]\n",
            "spec.yaml:8:19: 'vision' is an image, and a single_to_multi network takes vectors alone; leave it out, \
             use network.preset: multi_to_multi, or give it convolutions by network.channels (after applying \
             input=vision)",
        ),
        (
            "vary:\n  training.kl_weight: [0, 1, 0]\n",
            "spec.yaml:8:30: 0 is in 'vary.training.kl_weight' twice",
        ),
    ]);
    let lists: String = (0..3)
        .map(|list| {
            let key = ["training.epochs", "training.batch_size", "training.patience"][list];
            let values: Vec<String> = (1..=20).map(|value| value.to_string()).collect();
            format!("  {key}: [{}]\n", values.join(", "))
        })
        .collect();
    let message = refusal(format!("{BASE}vary:\n{lists}"));
    assert!(
        message.contains("2 latent sizes, 8000 combinations of settings and 1 seeds make 32000 runs"),
        "{message}"
    );
}

#[test]
fn a_variant_is_what_its_settings_alone_make() {
    let networks = [
        "{preset: multi_to_multi}",
        "{preset: multi_to_multi, channels: [4], average: 2}",
        "{preset: single_to_multi, channels: [8, 16]}",
    ];
    for network in networks {
        let vectors =
            base_with(&format!("network: {network}")).replace("[proprioception, arm]", "proprioception");
        let inputs = ["[proprioception]", "[proprioception, vision]"];
        let text =
            format!("{vectors}vary: {{input: [{}], network.hidden: [[8], [16]]}}\n", inputs.join(", "));
        let runs = load(&text).runs();
        let mut alone = Vec::new();
        for input in inputs {
            for hidden in [8, 16] {
                let settings = [format!("input={input}"), format!("network.hidden={hidden}")];
                let settings = settings.each_ref().map(String::as_str);
                alone.extend(load_with(&vectors, &settings, false).unwrap().runs());
            }
        }
        assert_eq!(runs.len(), alone.len());
        for run in &runs {
            let alike = alone
                .iter()
                .filter(|one| spec::RunSpec { variant: run.variant.clone(), ..(*one).clone() } == *run);
            assert_eq!(alike.count(), 1, "{network}: {}", run.label());
        }
    }
}

#[test]
fn an_ablation_of_images_keeps_the_convolutions_of_its_spec() {
    let network = "network: {preset: multi_to_multi, channels: [4], average: 2}";
    let text = base_with(network).replace("[proprioception, arm]", "proprioception");
    let runs = load(&format!("{text}vary: {{input: [[proprioception], [proprioception, vision]]}}\n")).runs();
    let of_network = |input: &str| {
        let run = runs.iter().find(|run| run.variant == format!("input={input}")).unwrap();
        (
            run.trained().unwrap().network.channels().to_vec(),
            run.trained().unwrap().network.average,
            run.check(&Layout::finger()),
        )
    };
    assert_eq!(of_network("proprioception"), (vec![], 1, Ok(())));
    assert_eq!(of_network("proprioception+vision"), (vec![4], 2, Ok(())));
    // The images of a preset's own convolutions: 16 channels.
    let text =
        base_with("network: {preset: multi_to_multi}").replace("[proprioception, arm]", "proprioception");
    let runs = load(&format!("{text}vary: {{input: [[proprioception], [proprioception, vision]]}}\n")).runs();
    let channels: Vec<usize> =
        runs.iter().flat_map(|run| run.trained().unwrap().network.channels()).copied().collect();
    assert_eq!(channels, [16].repeat(4));
    let yaml = load(&text).to_yaml();
    assert_eq!(load(&yaml), load(&text));
}

#[test]
fn an_ablation_leaves_out_one_modality_after_the_other() {
    let text = base_with("input: [contact_force, proprioception, arm]");
    let ablation = format!("{text}vary: {{input: {{without: each}}}}\n");
    let list = "[contact_force, proprioception, arm], [proprioception, arm], [contact_force, arm], \
                [contact_force, proprioception]";
    let listed = load(&format!("{text}vary: {{input: [{list}]}}\n"));
    assert_eq!(load(&ablation), listed);
    assert_eq!(load_with(&text, &["vary={input: {without: each}}"], false).unwrap(), listed);
    let quick =
        load_with(format!("{text}quick: {{vary: {{input: {{without: each}}}}}}\n"), &[], true).unwrap();
    assert_eq!(quick.vary, listed.vary);
    // The command of a run names only its own input, in the order of the spec.
    let runs = listed.runs();
    assert_eq!(runs[2].variant, "input=proprioception+arm");
    let own = runs[2].own_override("vary={input: {without: each}}");
    assert_eq!(own, "vary={\"input\":[[\"proprioception\",\"arm\"]]}");
    assert_eq!(load_with(&text, &[&own], false).unwrap().runs()[0], runs[2]);
    // As everywhere, an input that is given alone is used alone.
    let alone = load_with(&ablation, &["input=[arm, contact_force]"], false).unwrap();
    assert_eq!(alone.runs()[0].variant, "input=arm+contact_force");
    assert_eq!(alone.runs().len(), 4);
}

#[test]
fn an_ablation_that_leaves_nothing_out_is_refused() {
    let form = "spec.yaml:8:10: 'vary.input': expected a list of inputs, or {without: each} for the input and the \
                input without each of its modalities";
    assert_refused(&[("vary:\n  input: {without: arm}\n", form), ("vary:\n  input: {with: each}\n", form)]);
    let single = base_with("input: arm") + "vary: {input: {without: each}}\n";
    let said = refusal(single);
    assert!(
        said.contains("'vary.input': the input has a single modality, so none can be left out"),
        "{said}"
    );
}

#[test]
fn labels_keep_the_order_of_the_spec() {
    let text = format!(
        "{BASE}vary: {{role: {{touch: {{}}, arm: {{input: arm}}, both: {{input: [arm, vision]}}}}}}\n"
    );
    let text = text.replace("single_to_multi", "multi_to_multi").replace("[empty, cluttered]", "empty");
    let variants = |experiment: &spec::Experiment| -> Vec<String> {
        let mut variants: Vec<String> = experiment.runs().iter().map(|run| run.variant.clone()).collect();
        variants.dedup();
        variants
    };
    let experiment = load(&text);
    assert_eq!(variants(&experiment), ["role=touch", "role=arm", "role=both"]);
    assert_eq!(variants(&load(&experiment.to_yaml())), variants(&experiment));
}

#[test]
fn labels_of_an_axis_make_runs_and_build_on_each_other() {
    let axis = |name: &str| {
        format!(
            "{BASE}vary:\n  training.epochs: [7, 5]\n  {name}:\n    both: {{extends: arm, training.dropout: 0.5}}\n    \
             arm: {{input: arm, training.dropout: 0.1}}\n"
        )
    };
    let runs = load(&axis("senses")).runs();
    let variants: Vec<&str> = runs.iter().step_by(2).take(4).map(|run| &*run.variant).collect();
    assert_eq!(
        variants,
        ["senses=both,epochs=7", "senses=both,epochs=5", "senses=arm,epochs=7", "senses=arm,epochs=5"]
    );
    assert_eq!(runs[0].input, [Modality::ARM]);
    assert_eq!([0, 4].map(|index| runs[index].trained().unwrap().training.dropout), [0.5, 0.1]);
    // The command line replaces the values of settings, and leaves axes with labels.
    let one =
        load_with(axis("senses"), &["vary={training.epochs: [3]}", "training.dropout=0"], false).unwrap();
    assert!(one.runs().iter().all(|run| run.variant.ends_with(",epochs=3")), "{:?}", one.vary);
    assert_eq!(one.runs()[0].trained().unwrap().training.dropout, 0.0);
    let given =
        "vary={senses: {both: {extends: arm, action: target}, arm: {input: arm}}, training.epochs: [7, 5]}";
    assert_eq!(
        runs[4].own_override(given),
        "vary={\"senses\":{\"arm\":{\"input\":\"arm\"}},\"training.epochs\":[7]}"
    );
    assert_refused(&[
        (
            "vary: {senses: {a: {extends: b}, b: {extends: a}}}\n",
            "spec.yaml:7:47: 'vary.senses.b.extends': a extends itself: a > b > a",
        ),
        (
            "vary: {senses: {arm: {}, b: {extends: amr}}}\n",
            "spec.yaml:7:39: unknown label 'amr' in 'vary.senses.b.extends'; did you mean 'arm'? Allowed: arm, b",
        ),
        (
            "vary: {senses: {}}\n",
            "spec.yaml:7:16: 'vary.senses': expected a section with at least one key, found an empty section",
        ),
        (
            "vary: {senses: {a: {extends: [a]}}}\n",
            "spec.yaml:7:30: 'vary.senses.a.extends': expected the name of a label, found a list of 1",
        ),
        (
            "vary: {hidden: {a: {}}}\n",
            "spec.yaml:7:16: 'hidden' can't name an axis with labels, because it has another meaning; use another name",
        ),
    ]);
}

#[test]
fn a_spec_builds_on_other_specs() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("lab")).unwrap();
    let path = |name: &str| folder.path().join(name);
    let write = |name: &str, text: &str| std::fs::write(path(name), text).unwrap();
    let load = |name: &str| spec::load(&path(name), &[], false);
    let refusal = |name: &str| {
        load(name).unwrap_err().to_string().replace(&format!("{}/", folder.path().display()), "")
    };
    write(
        "lab/base.yaml",
        &format!("{BASE}training: {{epochs: 7, dropout: 0.5}}\nvary: {{action: [target]}}\n"),
    );
    write("middle.yaml", "extends: lab/base.yaml\nname: middle\ntraining: {epochs: 9}\nvary: null\n");
    write("own.yaml", "extends: middle.yaml\nname: own\ntraining: {patience: null}\nlatent: 3\n");
    let (own, mut base) = (load("own.yaml").unwrap(), load("lab/base.yaml").unwrap());
    assert_eq!((own.training.epochs, own.training.dropout, own.training.patience), (9, 0.5, None));
    base.training.epochs = 9;
    base.training.patience = None;
    base.vary.clear();
    let base = Experiment { name: "own".into(), latent: vec![3], ..base };
    assert_eq!(own.runs(), base.runs());
    // An axis replaces that of the base. Nothing in its place leaves it out.
    write(
        "axes.yaml",
        &format!("{BASE}vary: {{senses: {{a: {{}}, b: {{action: target}}}}, training.epochs: [3, 4]}}\n"),
    );
    write("fewer.yaml", "extends: axes.yaml\nname: a\nvary: {senses: {c: {}}, training.epochs: null}\n");
    assert!(load("fewer.yaml").unwrap().runs().iter().all(|run| run.variant == "senses=c"));
    // A built-in spec is found by its name. Faults are those of the file with the value.
    write("first.yaml", "extends: smoke.yaml\nname: mine\n");
    assert_eq!(load("first.yaml").unwrap().network.hidden, [16]);
    let cases = [
        ("a: 1\nextends: gone.yaml\n", "wrong.yaml:2:10: 'extends': gone.yaml: there is no such file"),
        (
            "extends: [own.yaml]\nname: a\n",
            "wrong.yaml:1:10: 'extends': expected the path of a spec, found a list of 1",
        ),
        ("extends: own.yaml\n", "wrong.yaml:1:1: missing 'name'"),
        (
            "extends: own.yaml\nname: a\ninput: [visoin]\n",
            "wrong.yaml:3:9: unknown modality 'visoin' in 'input'",
        ),
        (
            "extends: bad.yaml\nname: a\n",
            "bad.yaml:3:9: 'action': expected one of increment, target, found 3",
        ),
        ("extends: broken.yaml\nname: a\n", "broken.yaml:1:1: broken YAML"),
        (
            "extends: wrong.yaml\nname: a\n",
            "wrong.yaml:1:10: 'extends': wrong.yaml > wrong.yaml: a spec can't extend itself",
        ),
    ];
    write("bad.yaml", "extends: own.yaml\nname: bad\naction: 3\n");
    write("broken.yaml", "[");
    for (text, expected) in cases {
        write("wrong.yaml", text);
        let said = refusal("wrong.yaml");
        assert!(said.starts_with(expected), "{text}{said}");
    }
}

#[test]
fn own_worlds_and_modalities_have_settings_by_dotted_key() {
    let text = BASE
        .replace("[proprioception, contact_force]", "[proprioception, grip]")
        .replace("cluttered", "own.yaml")
        + "vary: {scaling.grip.scale: [shared, per_element], simulation.hand_range: [[0, 1], [0, 2]],\n  \
           role: {plain: {}, heavy: {training.loss_weights.grip: 10, training.losses.grip: huber}}}\n\
           quick: {training.loss_weights.grip: 2}\n";
    // Keys that no world has are refused when the world is known. The keys themselves are allowed.
    let said = refusal(&text);
    assert!(said.contains("own.yaml") && !said.contains("unknown key"), "{said}");
    for (right, wrong) in [
        ("training.loss_weights.grip: 10", "training.loss_weights.Grip: 10"),
        ("scaling.grip.scale", "scaling.grip.scales"),
        ("training.losses.grip", "training.losses.grip.x"),
    ] {
        let said = refusal(text.replace(right, wrong));
        let key = wrong.split(':').next().unwrap();
        assert!(said.contains(&format!("unknown key '{key}'")), "{said}");
    }
    let said = refusal(text.replace("losses.grip: huber", "losses.grip: hubert"));
    assert!(said.contains("unknown loss 'hubert' in 'vary.role.heavy.training.losses.grip'"), "{said}");
}

#[test]
fn values_that_make_the_same_runs_are_refused() {
    assert_refused(&[
        (
            "vary:\n  training.kl_weight: [1, 0.5, 1.0]\n",
            "spec.yaml:8:32: 1.0 in 'vary.training.kl_weight' makes the same runs as 1; leave one of them out",
        ),
        (
            "vary:\n  input: [[arm, proprioception], arm, [proprioception, arm]]\n",
            "spec.yaml:8:39: [\"proprioception\",\"arm\"] in 'vary.input' makes the same runs as \
             [\"arm\",\"proprioception\"]; leave one of them out",
        ),
        (
            "vary: {training.epochs: [5, 6], network.channels: [[4], [8]]}\n",
            "spec.yaml:7:57: [8] in 'vary.network.channels' makes the same runs as [4]; leave one of them out",
        ),
    ]);
    // The channels matter where there are images.
    let several = base_with("network: {preset: multi_to_multi}")
        + "vary: {network.channels: [[4], [8]], input: [[arm], [vision]]}\n";
    let several = load(&several);
    assert_eq!(several.runs().len(), 2 * 2 * 4);
    assert_eq!(
        several.repetitions().unwrap(),
        "4 of 16 runs only repeat another one, because their settings have the same effect: \
         empty-z2-input=arm,channels=8-seed0 repeats empty-z2-input=arm,channels=4-seed0"
    );
    assert_eq!(load(BASE).repetitions(), None);
    // One value is left if another one is given on the command line.
    let text = format!("{BASE}vary: {{training.kl_weight: [1, 1.0]}}\n");
    assert_eq!(load_with(&text, &["training.kl_weight=1"], false).unwrap().runs().len(), 4);
}

#[test]
fn settings_of_outputs_are_those_that_training_stores() {
    let old = "training: {losses: {contact_force: huber}, loss_weights: {contact_force: 2}}\n";
    let new = "outputs: {contact_force: {loss: huber, weight: 2, predict: value}}\n";
    let runs = |text: &str, overrides: &[&str]| {
        let runs = load_with(format!("{BASE}{text}"), overrides, false).unwrap().runs();
        runs.iter().map(|run| (run.variant.clone(), run.hash())).collect::<Vec<_>>()
    };
    assert_eq!(runs(old, &[]), runs(new, &[]));
    // The later value counts, whichever key it has.
    let weighted =
        runs("training: {loss_weights: {contact_force: 3}, losses: {contact_force: huber}}\n", &[]);
    for text in [old, new] {
        for key in ["training.loss_weights.contact_force=3", "outputs.contact_force.weight=3"] {
            assert_eq!(runs(text, &[key]), weighted, "{text} {key}");
        }
    }
    // So it does in a label, and an override replaces all values of an axis.
    let hashes = |text: &str, overrides: &[&str]| -> Vec<String> {
        runs(text, overrides).into_iter().map(|(_, hash)| hash).collect()
    };
    let labels = |key: &str| format!("{new}vary: {{a: {{light: {{}}, heavy: {{{key}: 3}}}}}}\n");
    let [one, other] = ["outputs.contact_force.weight", "training.loss_weights.contact_force"].map(labels);
    assert_eq!(hashes(&one, &[]), hashes(&other, &[]));
    assert_ne!(hashes(&one, &[])[0], hashes(&one, &[]).pop().unwrap());
    let axis = format!("{new}vary: {{outputs.contact_force.weight: [2, 3]}}\n");
    assert_eq!(runs(&axis, &[]).len(), 2 * runs(new, &[]).len());
    assert_eq!(runs(&axis, &["training.loss_weights.contact_force=3"]).len(), runs(new, &[]).len());
    // A change is stored, and a value is not.
    let text = format!(
        "{}outputs: {{contact_force: {{predict: change}}}}\n",
        BASE.replace("input: [", "input: [contact_force, ")
    );
    let stored = serde_json::to_value(&load(&text).runs()[0]).unwrap();
    assert_eq!(stored["training"]["predict"], serde_json::json!({"contact_force": "change"}));
    assert!(load(BASE).runs()[0].to_yaml().lines().all(|line| !line.contains("predict:")));
    assert_refused(&[
        (
            &format!("{new}training: {{loss_weights: {{contact_force: 2}}}}\n"),
            "spec.yaml:7:48: 'training.loss_weights.contact_force' sets it as well; keep only one of them",
        ),
        (
            "outputs: {arm: {weight: 2}}\n",
            "spec.yaml:7:25: 'arm' is not an output; outputs: proprioception, contact_force",
        ),
        (
            "outputs: {contact_force: {predict: change}}\n",
            "spec.yaml:7:36: 'contact_force' is not an input, so the network does not know to what the change is \
             added; inputs: proprioception, arm",
        ),
        (
            "outputs: {contact_force: {predict: delta}}\n",
            "spec.yaml:7:36: unknown predict 'delta' in 'outputs.contact_force.predict'. Allowed: value, change",
        ),
        (
            "outputs: {proprioception: {distribution: hurdle}}\n",
            "spec.yaml:7:42: 'proprioception' is not bounded by 0, as a hurdle is; set scaling.proprioception.minimum \
             to 0, or use gaussian",
        ),
        (
            "outputs: {contact_force: {distribution: gaussian, loss: huber}}\n",
            "spec.yaml:7:57: the loss of 'contact_force' is the score of its distribution (gaussian); leave out one of \
             them",
        ),
        (
            "outputs: {proprioception: {weight: 0}, contact_force: {weight: 0}}\n",
            "spec.yaml:7:10: every output has weight 0, so there is nothing to learn",
        ),
    ]);
}

#[test]
fn a_reading_weights_outputs_that_only_some_roles_have() {
    let reading = "readings: [{name: heavy, choice: c, base: b, instead: i, paper: p, settings: \
        {training.loss_weights.arm: 3, training.loss_weights.contact_force: 2}}]\n";
    let text = format!(
        "{}vary: {{role: {{small: {{output: [contact_force]}}, large: {{output: [arm, contact_force]}}}}}}\n{reading}",
        BASE.replace("latent: [2, 4]", "latent: [2]")
    );
    let weights = |role: &str| {
        let runs = load(&text).runs();
        let of_role = |run: &&spec::RunSpec| run.variant.contains(role) && run.variant.contains("heavy");
        let run = runs.iter().find(of_role).unwrap();
        run.trained()
            .unwrap()
            .training
            .loss_weights
            .iter()
            .map(|(modality, weight)| (modality.name(), *weight))
            .collect::<Vec<_>>()
    };
    assert_eq!(weights("small"), [("contact_force", 2.0)]);
    assert_eq!(weights("large"), [("arm", 3.0), ("contact_force", 2.0)]);
    // No role predicts the camera's image.
    let said = refusal(text.replace("loss_weights.arm", "loss_weights.vision"));
    assert!(said.contains("'vision' is not an output"), "{said}");
}

/// A spec with two roles, two readings besides the base, and two datasets.
fn readings() -> String {
    let reading = |name: &str, settings: &str| {
        let texts = "choice: c, base: b, instead: i, paper: p";
        format!("- {{name: {name}, {texts}, settings: {{{settings}}}}}\n")
    };
    let lists = reading("target", "action: target") + &reading("long", "training.epochs: 7, split.by: time");
    base_with("scenarios: [empty]")
        + &format!("readings:\n{lists}vary:\n")
        + "  role: {small: {latent: 2, output: contact_force}, large: {latent: [4], training.epochs: 9}}\n"
        + "  simulation.seed: [0, 5]\n"
}

#[test]
fn each_reading_changes_one_choice_for_every_role_and_dataset() {
    let runs = load(&readings()).runs();
    let labels: Vec<String> = runs.iter().map(|run| run.label()).collect();
    let expected = ["base", "target", "long"].into_iter().flat_map(|reading| {
        [("small", 2), ("large", 4)].into_iter().flat_map(move |(role, latent)| {
            ["", "-data5"].map(|data| format!("empty-z{latent}-reading={reading},role={role}{data}-seed0"))
        })
    });
    assert_eq!(labels, expected.collect::<Vec<_>>());
    for run in &runs {
        let reading = run.reading().unwrap();
        assert_eq!(run.action == Action::Target, reading == "target");
        // A reading replaces the settings of a role.
        let epochs = match (reading, run.role().unwrap()) {
            ("long", _) => 7,
            (_, "large") => 9,
            _ => 200,
        };
        assert_eq!(run.trained().unwrap().training.epochs, epochs);
        assert_eq!(run.split.by == Division::Time, reading == "long");
        assert_eq!(run.output.len(), if run.role() == Some("small") { 1 } else { 2 });
        assert_eq!(run.trained().unwrap().training.loss_weights.len(), run.output.len());
    }
    assert_eq!(runs.iter().map(|run| run.dataset_seed()).collect::<Vec<_>>(), [0, 5].repeat(6));
    let plain = &load(BASE).runs()[0];
    assert_eq!((plain.reading(), plain.role(), plain.dataset_seed()), (None, None, 0));
}

#[test]
fn a_setting_that_is_given_counts_in_every_reading_and_role() {
    let runs = load_with(readings(), &["training.epochs=3", "latent=[8]"], false).unwrap().runs();
    assert!(runs.iter().all(|run| run.trained().unwrap().training.epochs == 3 && run.latent() == Some(8)));
    assert!(runs.iter().any(|run| run.split.by == Division::Time), "the rest of a reading stays");
}

#[test]
fn the_command_of_a_run_names_its_own_dataset() {
    let runs = load(&readings()).runs();
    let own = runs[1].own_override("vary={\"simulation.seed\": [0, 5]}");
    assert_eq!(own, "vary={\"simulation.seed\":[5]}");
}

#[test]
fn a_split_not_by_time_has_no_gap_though_the_spec_s_own_has() {
    let text = format!("{BASE}split: {{by: time}}\nvary: {{split.by: [time, sample]}}\n");
    let gaps: Vec<_> = load(&text).runs().iter().map(|run| run.split.gap_seconds.is_some()).collect();
    assert_eq!(gaps[..4], [true, true, false, false]);
}

#[test]
fn readings_that_cannot_be_told_apart_or_run_are_refused() {
    let reading = |name: &str, settings: &str| {
        format!(
            "readings: [{{name: {name}, choice: c, base: b, instead: i, paper: p, settings: {{{settings}}}}}]\n"
        )
    };
    assert_refused(&[
        (
            &reading("base", "action: target"),
            "spec.yaml:7:19: 'base' is the name of the reading with the spec's own settings; use another name",
        ),
        (
            &reading("a=b", "action: target"),
            "spec.yaml:7:19: 'a=b' can't name a reading; use 1 to 64 lower-case letters, digits and '_', a letter \
             first",
        ),
        (
            &reading("many", "simulation.episodes: 2"),
            "spec.yaml:7:99: a split by episode needs at least 3 episodes, one each for training, validation and test, \
             found 2; use more, or split.by: time, which divides each episode (after applying reading=many)",
        ),
        (
            "readings: [{name: a, choice: c, base: b}]\n",
            "spec.yaml:7:12: missing 'readings.instead', 'readings.paper', 'readings.settings'",
        ),
    ]);
    let unknown = [
        (
            "vary: {latent: [[2], [4]]}\n",
            "spec.yaml:7:8: 'latent' is a list already; leave it out of 'vary', and write latent: [2,4] at the top \
             level",
        ),
        (&reading("target", "latent: [2]"), "spec.yaml:7:80: unknown key 'latent' in 'readings.settings'"),
        ("vary: {role: {small: {seeds: [1]}}}\n", "spec.yaml:7:23: unknown key 'seeds' in 'vary.role.small'"),
    ];
    for (addition, expected) in unknown {
        let said = refusal(format!("{BASE}{addition}"));
        assert!(said.starts_with(expected), "{said}");
    }
    let twice = readings().replace("name: long", "name: target");
    assert_eq!(refusal(twice), "spec.yaml:9:10: there is a reading 'target' already");
    assert!(override_refusal("readings=[]").starts_with("override 'readings=[]': unknown key 'readings'"));
}

fn first_hash(text: &str) -> String {
    load(text).runs()[0].hash()
}

#[test]
fn the_hash_depends_on_what_decides_the_result_alone() {
    let same = "# A comment\n\
        training: {\"batch_size\": 1024, learning_rate: 0.001, loss_weights: {contact_force: 1}}\n\
        output: [contact_force, proprioception]\n\
        input:\n- arm\n- proprioception\n\
        network:\n    hidden: [0x100]\n    preset: single_to_multi\n\
        latent: [2]\n\
        name: another\n\
        description: Other words.\n\
        scenarios: [empty]\n\
        quick: {training.epochs: 1}\n";
    let hash = first_hash(BASE);
    assert_eq!(first_hash(same), hash);
    assert!(hash.len() == 16 && hash.chars().all(|c| c.is_ascii_hexdigit()), "{hash}");

    let changes = [
        "scenarios=[cluttered]",
        "input=[arm]",
        "output=[proprioception]",
        "latent=[3]",
        "seeds=[1]",
        "tasks=[prediction]",
        "action=target",
        "network.hidden=[255]",
        "simulation.seed=1",
        "simulation.lift_range_m=[-1, -0.001]",
        "split.test=0.2",
        "split.by=time",
        "split.by=sample",
        "scaling.contact_force.scale=per_element",
        "scaling.contact_force.minimum=null",
        "training.kl_weight=0.002",
        "training.loss_weights.contact_force=2",
    ];
    let mut hashes: Vec<String> =
        changes.iter().map(|change| load_with(BASE, &[change], false).unwrap().runs()[0].hash()).collect();
    hashes.push(hash);
    hashes.sort();
    hashes.dedup();
    assert_eq!(hashes.len(), changes.len() + 1);
}

/// Results are found by their hash, so the hash must not change between versions or platforms unnoticed.
#[test]
fn the_hash_is_stable() {
    assert_eq!(first_hash(BASE), "2464d348fe4365e4");
}

#[test]
fn later_settings_change_the_hash_only_where_they_are_set() {
    let with = |training: &str| first_hash(&format!("{BASE}training: {{{training}}}\n"));
    let defaults = "schedule: constant, warmup_epochs: 0, weight_decay: 0, clip_norm: null, stop: total, dropout: 0, \
         losses: {contact_force: squared}";
    assert_eq!(with(defaults), first_hash(BASE));
    let set = [
        "schedule: cosine",
        "warmup_epochs: 1",
        "weight_decay: 0.1",
        "clip_norm: 1",
        "stop: every_term",
        "losses: {contact_force: huber}",
    ];
    for setting in set {
        assert_ne!(with(setting), first_hash(BASE), "{setting}");
    }
}

/// The stored spec of a run leaves out most settings that came later, so that older runs keep their hashes.
#[test]
fn a_complete_spec_has_every_setting_with_its_default() {
    let run = load(BASE).runs().remove(0);
    let complete = run.complete(&Layout::finger());
    let has = |key: &str| key.split('.').try_fold(&complete, |section, key| section.get(key)).is_some();
    let used = run.modalities();
    let mut known = 0;
    for key in spec::setting_names() {
        let parts: Vec<&str> = key.split('.').collect();
        let expected = match parts[..] {
            ["training", "loss_weights" | "losses" | "distributions" | "predict", name] => {
                run.output.iter().any(|output| output.name() == name)
            }
            ["scaling", name, _] => used.iter().any(|modality| modality.name() == name),
            // The world `empty` has neither tendons nor pillars.
            ["simulation", name] => !name.ends_with("_n") && name != "pillar_clearance_m",
            ["network" | "split" | "training" | "tasks" | "action" | "input" | "output", ..] => true,
            _ => continue,
        };
        assert_eq!(has(&key), expected, "{key}");
        known += usize::from(expected);
    }
    assert!(known > 35, "{known}");
    assert_eq!(
        (&complete["split"]["by"], &complete["training"]["dropout"]),
        (&"episode".into(), &0.0.into())
    );
    assert_eq!(complete["training"]["losses"]["contact_force"], "squared");
    // What is stored is what it is in the complete spec.
    let stored = serde_json::to_value(&run).unwrap();
    assert!(stored["training"].get("dropout").is_none());
    for (section, settings) in stored.as_object().unwrap() {
        for (key, value) in settings.as_object().into_iter().flatten() {
            assert_eq!(complete[section][key], *value, "{section}.{key}");
        }
    }
}

#[test]
fn a_run_survives_json() {
    let run = load(BASE).runs().remove(0);
    let json = serde_json::to_string(&run).unwrap();
    assert_eq!(serde_json::from_str::<spec::RunSpec>(&json).unwrap(), run);
}

fn some<T: Copy>(values: &[T], random: &mut impl Rng) -> Vec<T> {
    let mut values = values.to_vec();
    values.shuffle(random);
    values.truncate(random.random_range(1..=values.len()));
    values
}

fn random_split(random: &mut impl Rng) -> Split {
    let by = *Division::ALL.choose(random).unwrap();
    let mut share = || random.random_range(0.01..0.3);
    let (validation, test) = (share(), share());
    // An episode may have only six samples, two for each part.
    let gap_seconds = (by == Division::Time).then_some(0.0);
    Split { by, validation, test: test.into(), gap_seconds, ..Split::default() }
}

fn random_scaling(modality: Modality, random: &mut impl Rng) -> GivenScaling {
    let minimum = if random.random() { Some(random.random_range(-1.0..1.0)) } else { None };
    let is_image = Layout::finger()[modality].is_image();
    let scale = if is_image { Scale::Shared } else { *Scale::ALL.choose(random).unwrap() };
    GivenScaling {
        scale: random.random::<bool>().then_some(scale),
        minimum: random.random::<bool>().then_some(minimum),
    }
}

/// A valid experiment with random settings, as `load` would return it.
fn random_experiment(random: &mut impl Rng) -> Experiment {
    const NAMES: [&str; 8] = ["a", "123", "1e3", "null", "true", "no", "0x1F", "-_-"];
    const TEXTS: [&str; 6] = ["", "a: b # c", "two\nlines\n", "'\"\\ \t", "ünï ✓", "- [x, {y"];
    let mut input = some(&Modality::BUILT_IN, random);
    let mut output = some(&Modality::BUILT_IN, random);
    input.sort();
    output.sort();
    let has_frame = input.iter().chain(&output).any(|modality| Layout::finger()[*modality].is_image());
    let network = Network {
        preset: *Preset::ALL.choose(random).unwrap(),
        hidden: (0..random.random_range(1..=3)).map(|_| random.random_range(1..=1024)).collect(),
        channels: Some(
            (0..if has_frame { random.random_range(1..=4) } else { 0 })
                .map(|_| random.random_range(1..=64))
                .collect(),
        ),
        average: if has_frame { *[1, 2, 4].choose(random).unwrap() } else { 1 },
        fusion: *Fusion::ALL.choose(random).unwrap(),
        ..Network::default()
    };
    let mut range = || {
        let (a, b): (f64, f64) = (random.random_range(-3.0..3.0), random.random_range(-3.0..3.0));
        [a.min(b), a.max(b)]
    };
    let ranges = [range(), range(), range()];
    let loss_weights = output.iter().map(|&modality| (modality, random.random_range(0.1..10.0))).collect();
    let vectors =
        output.iter().copied().filter(|modality| !Layout::finger()[*modality].is_image() && random.random());
    let losses = vectors.map(|modality| (modality, Loss::Absolute)).collect();
    // An input that is not the only one.
    let one = input.first().copied().filter(|_| input.len() > 1);
    Experiment {
        name: NAMES.choose(random).unwrap().to_string(),
        description: TEXTS.choose(random).unwrap().to_string(),
        scenarios: some(&Scenario::PAPER, random).into_iter().map(Origin::from).collect(),
        input,
        output,
        outputs: Default::default(),
        inputs: one.iter().map(|one| (*one, spec::Disturbance { delay: 2, ..Default::default() })).collect(),
        latent: some(&[1, 2, 16, 4096], random),
        seeds: some(&[0, 1, spec::MAX_SEED], random),
        tasks: if random.random() { vec![Task::Prediction] } else { Task::ALL.to_vec() },
        action: *Action::ALL.choose(random).unwrap(),
        window: Window::TRANSITION,
        network,
        simulation: Simulation {
            seed: random.random_range(0..=spec::MAX_SEED),
            episodes: random.random_range(3..=1000),
            actuations_per_episode: random.random_range(6..=100),
            actuation_seconds: f64::from(random.random_range(1..=20)) / 10.0,
            sample_rate_hz: *[10.0, 20.0, 100.0].choose(random).unwrap(),
            policy: None,
            factors: Vec::new(),
            test: false,
            world: [
                ("rotation_range_rad".to_owned(), Setting::Range(ranges[0])),
                ("lift_range_m".to_owned(), Setting::Range(ranges[1])),
                ("extension_range_m".to_owned(), Setting::Range(ranges[2])),
                ("box_clearance_m".to_owned(), Setting::Number(random.random_range(0.0..=0.2))),
            ]
            .into(),
        },
        split: random_split(random),
        test: None,
        given: one.iter().map(|one| spec::Given::Inputs(vec![*one])).collect(),
        probes: Vec::new(),
        scaling: Modality::BUILT_IN
            .iter()
            .map(|&modality| (modality, random_scaling(modality, random)))
            .collect(),
        training: Training {
            learning_rate: 10f64.powf(random.random_range(-12.0..0.0)),
            schedule: *Schedule::ALL.choose(random).unwrap(),
            warmup_epochs: *[0.0, 0.5, 1.0].choose(random).unwrap(),
            weight_decay: *[0.0, 0.01, 1.0].choose(random).unwrap(),
            clip_norm: *[None, Some(0.5), Some(10.0)].choose(random).unwrap(),
            batch_size: random.random_range(1..=4096),
            rollout_stride: *[1, 10].choose(random).unwrap(),
            discount: *[1.0, 0.7].choose(random).unwrap(),
            burn_in: *[0, 5].choose(random).unwrap(),
            truncate: *[None, Some(20)].choose(random).unwrap(),
            epochs: random.random_range(2..=1000),
            last_epoch: if random.random() { None } else { Some(1) },
            patience: if random.random() { Some(random.random_range(1..=100)) } else { None },
            stop: *Stop::ALL.choose(random).unwrap(),
            kl_weight: random.random_range(0.0..1e6),
            losses,
            distributions: Default::default(),
            recalibration: Default::default(),
            predict: Default::default(),
            loss_weights,
            dropout: if random.random() { 0.0 } else { random.random_range(0.0..1.0) },
            modality_dropout: one.map_or_else(spec::ModalityDropout::default, |one| {
                spec::ModalityDropout::Of([(one, 0.5)].into())
            }),
            precision: harness_spec::Precision::F32,
            tiles: random.random(),
            device: harness_spec::Device::Cpu,
        },
        vary: if random.random() {
            [("training.batch_size".to_owned(), vec![64, 128].into())].into_iter().collect()
        } else {
            Default::default()
        },
        search: random.random::<bool>().then(|| Search {
            method: Method::Sobol,
            trials: random.random_range(1..=3),
            seed: random.random_range(0..=spec::MAX_SEED),
            space: [("network.average".into(), Candidates::Choice(vec![1.into()]))].into(),
            objective: Default::default(),
            halving: None,
        }),
        readings: Vec::new(),
        quick: Default::default(),
        worlds: Vec::new(),
    }
}

#[test]
fn a_resolved_spec_loads_as_the_same_experiment() {
    let mut random = ChaCha8Rng::seed_from_u64(0);
    for _ in 0..300 {
        let experiment = random_experiment(&mut random);
        let yaml = experiment.to_yaml();
        let loaded = load_with(&yaml, &[], false).unwrap_or_else(|error| panic!("{error}\n{yaml}"));
        assert_eq!(loaded, experiment, "{yaml}");
    }
}

#[test]
fn a_runs_spec_can_be_written_as_an_experiment_of_its_own() {
    let mut random = ChaCha8Rng::seed_from_u64(2);
    for _ in 0..100 {
        let runs = random_experiment(&mut random).runs();
        let run = runs.choose(&mut random).unwrap();
        let experiment = load(&run.to_experiment_yaml("one"));
        assert_eq!(experiment.name, "one");
        assert_eq!(experiment.runs(), [spec::RunSpec { variant: String::new(), ..run.clone() }]);
    }
}

#[test]
fn a_damaged_spec_is_refused_in_one_line_without_panic() {
    let text = fs::read_to_string(experiments().join("multi_to_multi.yaml")).unwrap();
    let body = &text[text.find("name:").unwrap()..];
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut refused = 0;
    for _ in 0..2000 {
        let mut damaged = body.as_bytes().to_vec();
        for _ in 0..random.random_range(1..=3) {
            let position = random.random_range(0..damaged.len());
            damaged[position] = *b"\n\t -:,[]{}&*!|>'\"#%@09.ea\xff".choose(&mut random).unwrap();
        }
        if random.random_bool(0.1) {
            damaged.truncate(random.random_range(0..damaged.len()));
        }
        if let Err(message) = load_with(&damaged, &[], true) {
            refused += 1;
            assert!(message.starts_with("spec.yaml:") && !message.contains('\n'), "{message:?}");
        }
    }
    assert!(refused > 1000, "{refused}");
}

#[test]
fn names_are_those_of_serde() {
    fn check<T: Copy + serde::Serialize + std::fmt::Display>(all: &[T]) {
        for value in all {
            assert_eq!(serde_json::to_value(value).unwrap(), value.to_string());
        }
    }
    check(&Scenario::PAPER);
    check(&Modality::BUILT_IN);
    check(Action::ALL);
    check(Task::ALL);
    check(Preset::ALL);
    check(Fusion::ALL);
    check(Schedule::ALL);
    check(Stop::ALL);
    check(Division::ALL);
    check(Scale::ALL);
    check(Loss::ALL);
}

fn experiments() -> std::path::PathBuf {
    Path::new(ROOT).join("experiments")
}

#[test]
fn every_experiment_here_loads_under_its_file_name() {
    let mut names = Vec::new();
    for entry in fs::read_dir(experiments()).unwrap() {
        let path = entry.unwrap().path();
        // The file of claims is not a spec.
        if path.extension().is_some_and(|extension| extension == "yaml") && !path.ends_with("claims.yaml") {
            let stem = path.file_stem().unwrap().to_str().unwrap();
            for quick in [false, true] {
                // These take seconds, so they have no `quick` settings.
                if ["first", "smoke"].contains(&stem) && quick {
                    continue;
                }
                let experiment = spec::load(&path, &[], quick).unwrap_or_else(|error| panic!("{error}"));
                assert_eq!(experiment.name, if quick { format!("{stem}-quick") } else { stem.to_owned() });
            }
            names.push(path);
        }
    }
    assert!(names.len() >= 3, "{names:?}");
}

/// A quick run must have every stage and table of the full run. It may be smaller, but not different otherwise.
#[test]
fn the_papers_experiments_are_the_papers_also_when_quick() {
    let expected = [("single_to_multi", [2, 4, 16], 5), ("multi_to_multi", [16, 64, 128], 3)];
    for (name, latent, seeds) in expected {
        let path = experiments().join(format!("{name}.yaml"));
        let full = spec::load(&path, &[], false).unwrap();
        assert_eq!(full.latent, latent);
        assert_eq!(full.seeds.len(), seeds);
        assert_eq!(full.scenarios, [Scenario::EMPTY, Scenario::CLUTTERED].map(Origin::from));
        let samples = full.simulation.samples_per_episode() * full.simulation.episodes as usize;
        let training = &full.training;
        assert_eq!((samples, training.batch_size, training.epochs), (40_000, 1024, 200));
        assert_eq!(training.learning_rate, 1e-3);

        let quick = spec::load(&path, &[], true).unwrap();
        assert_eq!(quick.name, format!("{name}-quick"), "results of their own");
        assert!(quick.training.epochs < full.training.epochs);
        let resized = Experiment {
            name: full.name.clone(),
            simulation: full.simulation.clone(),
            training: full.training.clone(),
            seeds: full.seeds.clone(),
            ..quick
        };
        assert_eq!(resized, full);
    }
}

#[test]
fn the_origin_of_each_value_is_known() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("own.yaml");
    let text = "extends: smoke.yaml\nname: own\naction: target\nvary:\n  simulation.seed: [0, 1]\n  senses:\n    one: {}\n    \
                two: {input: [arm]}\n";
    std::fs::write(&path, text).unwrap();
    let explained = spec::explain(&path, &["training.epochs=3".into()], false).unwrap();
    assert_eq!(explained.iter().map(|one| &*one.variant).collect::<Vec<_>>(), ["senses=one", "senses=two"]);
    let source = |variant: usize, key: &str| {
        let found = explained[variant].settings.iter().find(|setting| setting.key == key).unwrap();
        let source = found.source.clone().unwrap_or("default".into());
        format!("{} {}", found.value, source.replace(&path.display().to_string(), "own.yaml"))
    };
    let base = |line: usize| format!("the built-in experiments/smoke.yaml:{line}");
    assert_eq!(source(0, "action"), "\"target\" own.yaml:3");
    assert_eq!(source(0, "input"), format!("[\"proprioception\",\"vision\"] {}", base(10)));
    assert_eq!(source(1, "input"), "[\"arm\"] senses=two, own.yaml:8");
    assert_eq!(source(1, "training.epochs"), "3 override");
    assert_eq!(source(1, "simulation.seed"), "[0,1] simulation.seed, own.yaml:5");
    assert_eq!(source(1, "training.dropout"), "0.0 default");
}

/// Editors read this file. `harness schema > experiments/schema.json` updates it.
#[test]
fn the_schema_for_editors_is_up_to_date() {
    let path = experiments().join("schema.json");
    let schema = spec::schema_text(&spec::schema());
    if std::env::var_os("UPDATE").is_some() {
        fs::write(&path, &schema).unwrap();
    }
    let advice = "experiments/schema.json is out of date; UPDATE=1 cargo test --test spec writes it";
    assert!(fs::read_to_string(path).unwrap() == schema, "{advice}");
    // Each setting is described once.
    assert!(schema.lines().count() <= 2700, "{} lines", schema.lines().count());
}

/// The names of runs contain the hash of what is stored.
#[test]
fn specs_of_published_runs_are_stored_as_they_were() {
    let runs = experiments().join("../results/reference/runs");
    let mut checked = 0;
    for experiment in fs::read_dir(runs).unwrap() {
        let text = fs::read(experiment.unwrap().path().join("records.json")).unwrap();
        let list: serde_json::Value = serde_json::from_slice(&text).unwrap();
        for record in list["records"].as_array().unwrap() {
            let read: spec::RunSpec = serde_json::from_value(record["spec"].clone()).unwrap();
            assert_eq!(serde_json::to_value(&read).unwrap(), record["spec"]);
            checked += 1;
        }
    }
    assert!(checked > 100, "{checked}");
}

#[test]
fn categories_refuse_settings_of_numbers() {
    let vector = |name: &str| Definition::vector(Modality::new(name).unwrap(), "", Vec::new());
    let modalities = vec![vector("touch"), Definition { category: true, ..vector("object") }];
    let layout = Layout { modalities, regions: Vec::new(), labels: Vec::new() };
    let text = "\
name: touched
scenarios: touched-0123456789abcdef
input: touch
output: [object, touch]
latent: 2
network: {preset: single_to_multi}
";
    let check = |text: &str, line: &str| load(&format!("{text}{line}\n")).runs()[0].check(&layout);
    assert_eq!(
        check(text, "outputs: {touch: {predict: change, loss: huber}, object: {weight: 0.1}}"),
        Ok(())
    );
    let cases = [
        (
            "outputs: {object: {loss: huber}}",
            "outputs.object.loss: 'object' has categories, whose loss is the ",
        ),
        (
            "outputs: {object: {distribution: gaussian}}",
            "outputs.object.distribution: 'object' has categories, whose ",
        ),
        (
            "scaling: {object: {minimum: 0}}",
            "'object' has categories, which are not scaled; leave out scaling.object",
        ),
    ];
    for (line, message) in cases {
        let error = check(text, line).unwrap_err();
        assert!(error.starts_with(message), "{line}: {error}");
    }
    let both = text.replace("input: touch", "input: [touch, object]");
    let error = check(&both, "outputs: {object: {predict: change}}").unwrap_err();
    assert_eq!(
        error,
        "outputs.object.predict: 'object' has categories, which have no change; predict their value"
    );
    assert_eq!(check(&both, ""), Ok(()));
    let modalities = vec![vector("touch"), Definition { unit_vectors: true, ..vector("object") }];
    let layout = Layout { modalities, regions: Vec::new(), labels: Vec::new() };
    let spec = load(&format!("{text}outputs: {{object: {{loss: huber}}}}\n"));
    let error = spec.runs()[0].check(&layout).unwrap_err();
    assert_eq!(
        error,
        "outputs.object.loss: 'object' has unit vectors, whose loss is 1 minus the cosine of the angle; leave it out"
    );
    let further = format!("{both}window: {{horizon: 2}}\n");
    assert_eq!(check(&further, ""), Ok(()));
    let error = load(&further).runs()[0].check(&layout).unwrap_err();
    assert!(
        error.starts_with("window.horizon: a network without memory predicts further than one"),
        "{error}"
    );
    assert!(error.contains("of its input 'object' it predicts only the direction"), "{error}");
}

#[test]
fn folds_are_runs_so_that_their_number_and_the_test_are_not_chosen_as_well() {
    let spec = BASE.replace("[empty, cluttered]", "lab-0123456789abcdef");
    let error = |more: &str| load_with(format!("{spec}{more}"), &[], false).unwrap_err();
    for more in
        ["vary: {split.folds: [2, 3]}", "vary: {kind: {two: {split.folds: 2}, three: {split.folds: 3}}}"]
    {
        let error = error(more);
        assert!(error.contains("'split.folds' can't vary, because there is a run for each fold"), "{error}");
        assert!(error.starts_with("spec.yaml:7:"), "{error}");
    }
    let error = error("split: {by: object, folds: 3, test: [book]}");
    assert!(
        error.contains("each fold is the test of a run; leave out split.test, or split.folds"),
        "{error}"
    );
}

#[test]
fn a_disturbance_is_overridden_key_by_key() {
    for (given, name) in [("inputs={arm: {noise: 1}}", "NAME"), ("inputs.arm={noise: 1}", "arm")] {
        let error = load_with(BASE, &[given], false).unwrap_err();
        let expected = format!("is a section; override its keys one by one, such as inputs.{name}.noise=0.1");
        assert!(error.contains(&expected), "{error}");
    }
    load_with(BASE, &["inputs.arm.noise=0.1"], false).unwrap();
}

/// A keyword that the checks overlook would bind editors alone, so each must be one that they know.
#[test]
fn the_checks_know_every_keyword_of_the_schemas() {
    // `not` makes a name fit one choice only.
    const ANNOTATIONS: &[&str] = &["$schema", "title", "description", "default", "format", "not"];
    // `pattern` stands for the rules of names and of `Origin`, and `if` with `then` for the rule of a mapping that a
    // modality has columns or a label.
    const CHECKED: &[&str] = &[
        "$defs",
        "$ref",
        "type",
        "properties",
        "required",
        "patternProperties",
        "additionalProperties",
        "items",
        "minItems",
        "maxItems",
        "minProperties",
        "maxProperties",
        "uniqueItems",
        "minimum",
        "maximum",
        "exclusiveMinimum",
        "exclusiveMaximum",
        "anyOf",
        "oneOf",
        "const",
        "pattern",
        "if",
        "then",
    ];
    fn visit(schema: &Value) {
        for (keyword, value) in schema.as_object().unwrap() {
            let keyword = keyword.as_str();
            assert!(ANNOTATIONS.contains(&keyword) || CHECKED.contains(&keyword), "{keyword}: {value}");
            match keyword {
                "$defs" | "properties" | "patternProperties" => {
                    value.as_object().unwrap().values().for_each(visit)
                }
                "items" => visit(value),
                "anyOf" | "oneOf" => value.as_array().unwrap().iter().for_each(visit),
                // False, or what every other key's value must be.
                "additionalProperties" if value.is_object() => visit(value),
                "additionalProperties" => assert_eq!(value, false),
                _ => {}
            }
        }
    }
    visit(&spec::schema());
    visit(&spec::mapping_schema());
}

/// The message about a wrong value has words for every part of the schema.
#[test]
fn a_wrong_value_of_any_setting_is_told_what_is_expected() {
    let schema = spec::schema();
    let settings = schema["properties"]["quick"]["properties"].as_object().unwrap();
    assert!(settings.len() > 100);
    for name in settings.keys() {
        let error = load_with(format!("{BASE}quick: {{{name}: [[{{}}]]}}\n"), &[], true).unwrap_err();
        let (_, words) = error.split_once("expected ").unwrap_or_else(|| panic!("{name}: {error}"));
        let known = ["a ", "an ", "one of ", "true or false", "null"];
        assert!(known.iter().any(|start| words.starts_with(start)), "{name}: {error}");
    }
}
