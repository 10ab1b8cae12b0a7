//! Tests of trained networks with some of their inputs or with disturbed ones, from the spec to tables and plots.

use crate::common::{SMOKE, ask, finish, fresh, harness, succeed};
use std::collections::BTreeMap;

const RUN: [&str; 8] = [
    "run",
    SMOKE,
    "scenarios=[empty]",
    "input=[proprioception,arm]",
    "output=[proprioception,contact_force]",
    "outputs.proprioception.predict=change",
    "window.horizon=2",
    "window.context=3",
];

/// The overall RMSE of the network by experiment, task, modality, horizon and what it got.
const SCORES: &str = "select experiment, task, modality, direction, horizon, given, value from all_metrics where \
                      model = 'network' and metric = 'rmse' and \"index\" is null";

#[test]
fn a_trained_network_is_also_tested_with_some_of_its_inputs() {
    let results = fresh("missing");
    let run = |more: &[&str]| succeed(&results, &[&RUN[..], more].concat());
    run(&["network.memory=gru"]);
    run(&["network.memory=gru", "name=some", "given=each"]);
    let dropped = "training.modality_dropout={arm: 0.9}";
    run(&["network.memory=gru", "name=dropped", "given=[[proprioception]]", dropped]);
    let mut scores: BTreeMap<String, BTreeMap<Option<String>, Vec<f64>>> = BTreeMap::new();
    for row in ask(&results, SCORES) {
        let of_experiment = scores.entry(row["experiment"].as_str().unwrap().to_owned()).or_default();
        let given = row["given"].as_str().map(str::to_owned);
        of_experiment.entry(given).or_default().push(row["value"].as_f64().unwrap());
    }
    let [arm, angles] = ["arm", "proprioception"].map(|name| Some(name.to_owned()));
    let some = &scores["some"];
    assert_eq!(some.keys().cloned().collect::<Vec<_>>(), [None, arm.clone(), angles.clone()]);
    // Two outputs at two horizons, whole and in two directions, and both inputs again, of which the arm has two units.
    assert_eq!(some.values().map(Vec::len).collect::<Vec<_>>(), [17; 3]);
    // The test with all inputs is the one of a network that is tested with nothing else.
    assert_eq!(some[&None], scores["smoke"][&None]);
    assert!(some[&None] != some[&arm] && some[&arm] != some[&angles]);
    assert_ne!(scores["dropped"][&None], some[&None]);

    let sums = "select count(distinct given) as n from sums where experiment = 'some'";
    assert_eq!(ask(&results, sums)[0]["n"], 2);
    let table =
        |arguments: &[&str]| succeed(&results, &[&["compare", "some", "--metrics=rmse"], arguments].concat());
    let by = table(&["--by", "given"]);
    for column in ["all inputs", "arm", "proprioception", "persistence", "ridge"] {
        assert!(by.contains(column), "{by}");
    }
    assert!(!by.contains("persistence, all inputs"), "{by}");
    let means = |arguments: &[&str]| -> Vec<serde_json::Value> {
        let path = results.join("means.json");
        table(&[arguments, &["--output", path.to_str().unwrap(), "--of=contact_force"]].concat());
        serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap()
    };
    let of_network = |rows: Vec<serde_json::Value>| -> Vec<(Option<String>, f64)> {
        let rows = rows.iter().filter(|row| row["model"] == "network");
        rows.map(|row| (row["given"].as_str().map(str::to_owned), row["mean"].as_f64().unwrap())).collect()
    };
    let all = of_network(means(&["--by=given"]));
    assert_eq!(
        all.iter().map(|(given, _)| given.clone()).collect::<Vec<_>>(),
        [None, arm.clone(), angles.clone()]
    );
    assert_eq!(of_network(means(&["--given=arm"])), [all[1].clone()]);
    assert_eq!(of_network(means(&[])), [all[0].clone()]);
    let against = of_network(means(&["--by=given", "--against=all inputs"]));
    assert!((against[1].1 - (all[1].1 - all[0].1)).abs() < 1e-12, "{against:?}");

    let svg = results.join("given.svg");
    let plot =
        ["plot", "some", "--x=given", "--metrics=rmse", "--of=contact_force", "--models=network,ridge", "-o"];
    succeed(&results, &[&plot[..], &[svg.to_str().unwrap()]].concat());
    let drawn = std::fs::read_to_string(svg).unwrap();
    assert!(drawn.contains("<svg"));
    // The run of a spec that lists the tests explicitly is the same one.
    let again = run(&["network.memory=gru", "name=some", "given=[[arm],[proprioception]]"]);
    assert!(again.contains("0 done, 1 done before"), "{again}");
}

#[test]
fn a_network_is_trained_and_tested_with_disturbed_inputs() {
    let results = fresh("disturbed");
    let run = |more: &[&str]| {
        let own = ["tasks=[prediction]", "network.memory=gru"];
        succeed(&results, &[&RUN[..], &own, more].concat())
    };
    let given = "given=[{arm: {}, proprioception: {}}, {arm: {noise: 0.5}, proprioception: {}}]";
    run(&["name=clean", given]);
    run(&["name=noisy", "inputs.arm.noise=0.5"]);
    let scores = |experiment: &str, model: &str, given: &str| -> Vec<f64> {
        let sql = format!(
            "select value from all_metrics where experiment = '{experiment}' and model = '{model}' and metric = 'rmse' \
             and \"index\" is null and given {given} order by modality, direction, horizon"
        );
        ask(&results, &sql).iter().map(|row| row["value"].as_f64().unwrap()).collect()
    };
    let usual = scores("clean", "network", "is null");
    assert_eq!(scores("clean", "network", "= 'arm,proprioception'"), usual);
    let noisy = scores("clean", "network", "= 'arm noise=0.5,proprioception'");
    assert!(usual.len() == noisy.len() && usual != noisy && usual.len() == 12);
    assert_ne!(scores("noisy", "network", "is null"), usual);
    // Ridge regression gets what the network gets, and persistence repeats what was recorded.
    assert_ne!(scores("noisy", "ridge", "is null"), scores("clean", "ridge", "is null"));
    assert_eq!(scores("noisy", "persistence", "is null"), scores("clean", "persistence", "is null"));
    let table = succeed(&results, &["compare", "clean", "--by=given", "--metrics=rmse", "--models=network"]);
    for column in ["all inputs", "proprioception + arm", "proprioception + arm noise=0.5"] {
        assert!(table.contains(column), "{table}");
    }
    let table = succeed(
        &results,
        &["compare", "clean", "noisy", "--by=inputs.arm.noise", "--metrics=rmse", "--models=network"],
    );
    assert!(table.contains("arm.noise=0\n") && table.contains("arm.noise=0.5"), "{table}");
}

/// A slider that is driven, with its position under two names and its velocity.
const SLIDER: [(&str, &str); 2] = [
    (
        "slider.xml",
        r#"<mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0" damping="1"/><geom size=".1"/></body>
  </worldbody><actuator><position name="push" joint="x" kp="20" dampratio="1" ctrlrange="-1 1"/></actuator></mujoco>"#,
    ),
    (
        "slider.yaml",
        "model: slider.xml\nstep_rate_hz: 500\nsample_rate_hz: 10\nmodalities:\n  place: {joint_positions: x}\n  \
         again: {joint_positions: x}\n  speed: {joint_velocities: x}\naction: {seconds: 1, actuators: {push: \
         {actuator: push, range: [-1, 1]}}}\n",
    ),
];

#[test]
fn a_latent_state_is_probed_for_what_is_not_its_input() {
    let (results, folder) = (fresh("probes"), tempfile::tempdir().unwrap());
    for (name, text) in SLIDER {
        std::fs::write(folder.path().join(name), text).unwrap();
    }
    let world = format!("scenarios=[{}]", folder.path().join("slider.yaml").display());
    let of = ["input=[place]", "output=[place]", "simulation.episodes=40", "training.epochs=40", "latent=2"];
    let run = |more: &[&str]| succeed(&results, &[&["run", SMOKE, &world], &of[..], more].concat());
    run(&["name=without"]);
    run(&["probes=[again, speed, place]"]);
    let r2 = |experiment: &str, task: &str| -> BTreeMap<(String, String), f64> {
        let sql = format!(
            "select model, modality, value from metrics where experiment = '{experiment}' and task = '{task}'
             and metric = 'r2' and \"index\" is null"
        );
        let text = |row: &serde_json::Value, name: &str| row[name].as_str().unwrap().to_owned();
        let value =
            |row: &serde_json::Value| ((text(row, "model"), text(row, "modality")), row["value"].as_f64());
        ask(&results, &sql).iter().map(value).map(|(key, value)| (key, value.unwrap())).collect()
    };
    assert_eq!(r2("smoke", "prediction"), r2("without", "prediction"));
    let found = r2("smoke", "reconstruction");
    let of = |model: &str, modality: &str| found[&(model.to_owned(), modality.to_owned())];
    // A regression recovers what is linear in the input. The place does not tell the speed.
    assert!(of("ridge", "again") > 0.999 && of("nearest_neighbors", "again") > 0.99, "{found:?}");
    assert!(of("network", "again") > 0.9 && of("network", "speed") < 0.6, "{found:?}");
    assert_eq!(of("network", "again") > 0.9, of("network", "place") > 0.9);
    for model in ["ridge", "nearest_neighbors", "untrained"] {
        // What is reconstructed of the input has no such baselines.
        assert!(!found.contains_key(&(model.to_owned(), "place".to_owned())), "{found:?}");
        assert!(found.contains_key(&(model.to_owned(), "speed".to_owned())), "{found:?}");
    }
    // Tables show the untrained encoder in a column of its own, and `show` means the network.
    let compared = succeed(&results, &["compare", "smoke", "--task", "reconstruction", "--metrics", "r2"]);
    let header = compared.lines().next().unwrap();
    assert!(header.contains("untrained") && header.contains("nearest neighbors"), "{compared}");
    let own = format!("{:.3}", of("network", "speed"));
    assert!(succeed(&results, &["show", "smoke/"]).contains(&own), "{own}");
}

#[test]
fn probes_that_no_run_can_have_are_refused() {
    let results = fresh("probes_refused");
    let refused = |more: &[&str]| {
        let answer = finish(&mut harness(&results, &[&["run", SMOKE][..], more].concat()));
        assert_eq!(answer.code, 2);
        answer.stderr
    };
    let unknown = refused(&["probes=[proprioceptoin]"]);
    assert!(
        unknown.contains("unknown modality 'proprioceptoin' in 'probes'; did you mean 'proprioception'?"),
        "{unknown}"
    );
    let without = refused(&["probes=[arm]", "tasks=[prediction]"]);
    assert!(without.contains("add reconstruction to 'tasks'"), "{without}");
}
