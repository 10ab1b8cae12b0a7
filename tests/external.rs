//! Runs of models of other programs: recorded, listed, compared and removed like runs that train a network.

use crate::common::{SMOKE, finish, harness, smoke_run, succeed};
use harness::judge::{MetricRow, PredictionRow};
use harness::metrics::evaluate;
use harness::registry::{Outcome, Registry};
use harness::spec::{self, Layout, Modality, Model, RunSpec, Task};
use std::path::Path;

/// The spec of an external model's run in the empty scenario of the smoke experiment.
fn external(name: &str, seed: u64) -> RunSpec {
    let run = spec::load(Path::new(SMOKE), &[], false).unwrap().runs().remove(0);
    let (model, variant) = (Model::External(name.to_owned()), format!("model={name}"));
    RunSpec { model, variant, seed, tasks: vec![Task::Prediction], ..run }
}

/// Writes a finished run of an external model whose predictions of the contact force are wrong by `error`.
fn write(results: &Path, spec: &RunSpec, error: f32) -> String {
    let registry = Registry::new(results);
    let dataset = registry.records()[0].dataset.clone();
    let folder = registry.run("smoke", spec, &dataset);
    let run = registry.claim(&folder).unwrap().unwrap();
    let record =
        run.begin(spec, &Layout::finger(), &harness::experiment::provenance(1, "judge".into())).unwrap();
    let reference: Vec<f32> = (0..200).map(|place| (place as f32 * 0.37).sin().abs()).collect();
    let predicted: Vec<f32> = reference.iter().map(|value| value + error).collect();
    let (task, horizon, given) = (Task::Prediction, 1, None);
    let rows = evaluate(&Layout::finger()[Modality::CONTACT_FORCE], &reference, &predicted).unwrap();
    let model = "network".to_owned();
    let row = |row| MetricRow { task, model: model.clone(), horizon, given, row };
    let values = reference.iter().zip(&predicted).enumerate();
    let outcome = Outcome {
        metrics: rows.into_iter().map(row).collect(),
        predictions: values
            .map(|(place, (reference, predicted))| PredictionRow {
                task,
                horizon: 1,
                given,
                modality: Modality::CONTACT_FORCE,
                episode: 3,
                sample: place as u32 / 20,
                index: place as u32 % 20,
                reference: *reference,
                predicted: *predicted,
            })
            .collect(),
        ..Outcome::default()
    };
    run.finish(record, &outcome).unwrap();
    folder.id().to_owned()
}

#[test]
fn a_run_has_a_network_or_an_external_model() {
    let spec = external("my_gru", 3);
    assert_eq!(spec.label(), "empty-model=my_gru-seed3");
    let json = serde_json::to_value(&spec).unwrap();
    assert_eq!((&json["model"], json.get("latent"), json.get("training")), (&"my_gru".into(), None, None));
    assert_eq!(serde_json::from_value::<RunSpec>(json.clone()).unwrap(), spec);
    assert_ne!(external("my_gru", 4).hash(), spec.hash());
    assert_ne!(external("other", 3).hash(), spec.hash());
    let refused = |key: &str, value: serde_json::Value| {
        let mut json = json.clone();
        json[key] = value;
        serde_json::from_value::<RunSpec>(json).unwrap_err().to_string()
    };
    assert_eq!(
        refused("latent", 4.into()),
        "a run has 'latent', 'network' and 'training', or it has 'model'"
    );
    assert!(refused("colour", 4.into()).starts_with("unknown field `colour`"));
}

#[test]
fn commands_take_runs_of_external_models() {
    let results = smoke_run("external");
    let runs = [("my_gru", 0), ("my_gru", 1), ("other", 0)]
        .map(|(name, seed)| write(&results, &external(name, seed), 0.1 * (seed + 1) as f32));
    let listed = succeed(&results, &["ls"]);
    assert!(runs.iter().all(|run| listed.contains(run.as_str())), "{listed}");
    let answer = succeed(
        &results,
        &[
            "query",
            "select architecture, latent is null as without, count(*) as runs from runs group by all
                    order by architecture",
            "--format",
            "csv",
        ],
    );
    assert_eq!(answer, "architecture,without,runs\nmulti_to_multi,false,2\nmy_gru,true,2\nother,true,1\n");
    let compared = succeed(&results, &["compare", "smoke", "--format", "csv", "--where", "scenario=empty"]);
    assert!(compared.contains("model=my_gru") && compared.contains("model=other"), "{compared}");
    assert!(succeed(&results, &["verify"]).contains("all files are intact"));
    assert!(succeed(&results, &["show", &runs[0]]).contains("my_gru"));
    // The runs of the experiment are still done, and none of the others is repeated.
    assert!(succeed(&results, &["run", SMOKE]).contains("2 done before"));
    let refused = finish(&mut harness(&results, &["export", "--format", "onnx", &runs[0], "model.onnx"]));
    assert!(refused.code != 0 && refused.stderr.contains("come from another program"), "{}", refused.stderr);
    succeed(&results, &["rm", &runs[2], "--yes"]);
    assert!(!succeed(&results, &["ls"]).contains(&runs[2]));
}
