//! What others may add: a network with a state, a fusion of encoders, a baseline, and recorded predictions. Each is one
//! file and one registration, and is then trained or judged like what the harness has.

mod toy_baseline;
mod toy_fusion;
mod toy_network;

use super::*;
use harness_judge::{
    Asked, Judged, Persistence, PredictionRow, Predictor, Recorded, RecordedError, RecordedValue, Test, judge,
};
use harness_learning::network::{Cvae, Network as Predicting};
use harness_learning::predict::{Latents, TrainedNetwork};
use harness_metrics::Metric;
use harness_spec::WindowStart;
use harness_tables::read_predicted;
use std::path::PathBuf;

/// The window of these tests.
const WINDOW: Window = Window { context: 3, start: WindowStart::Random, horizon: 5, since_s: Vec::new() };

/// The registration of what these tests add.
struct Added {
    network: Box<dyn Predicting>,
    fusion: Box<dyn Encoder>,
    baseline: Box<dyn Predictor>,
    predictions: PathBuf,
}

impl Added {
    /// Returns it with the parameters of the network and of the encoders.
    fn new(bench: &Bench) -> (Self, [Parameters; 2]) {
        let mut parameters = [Parameters::new(), Parameters::new()];
        let network = toy_network::Integrator::new(ARM_JOINTS, &mut parameters[0]).unwrap();
        let mut encoder = |input: Modality| {
            let architecture = Architecture { input: vec![input], ..bench.architecture() };
            let mut own = Parameters::new();
            let encoder = architecture.encoder(&mut own, &mut random(1), &Device::Cpu).unwrap();
            parameters[1].extend(own.into_iter().map(|(name, var)| (format!("{input}.{name}"), var)));
            encoder
        };
        let added = Self {
            network: Box::new(network),
            fusion: Box::new(toy_fusion::MeanOfBoth(encoder(INPUT[0]), encoder(INPUT[1]))),
            baseline: Box::new(toy_baseline::Zero(Modality::ARM, ARM_JOINTS, WINDOW.horizons())),
            predictions: tests().join("toy_predictions.csv"),
        };
        (added, parameters)
    }
}

/// Trains a network on windows, and returns the total loss of each epoch.
fn fitted(
    bench: &Bench,
    network: Box<dyn Predicting>,
    parameters: &Parameters,
    window: &Window,
    [input, output]: [&[Modality]; 2],
    epochs: usize,
) -> Vec<f64> {
    let training =
        Training { epochs, learning_rate: 0.02, patience: None, batch_size: 8, ..Training::default() };
    let objective = Prediction {
        data: &bench.data,
        network,
        window,
        input,
        output,
        training: &training,
        score: Score::Loss,
    };
    let partition = &bench.data.samples.partition(&Split::default(), window).unwrap();
    let (state, progress) = (&StateFile::none(), &harness_shared::progress::Silent);
    let fit = Fit {
        task: Task::Prediction,
        training: &training,
        seed: 0,
        partition,
        state,
        progress,
        log: &|_| (),
    };
    let epochs = fit.run(&objective, parameters).unwrap();
    epochs.iter().map(|epoch| epoch.train[TOTAL]).collect()
}

/// The folder of these tests.
fn tests() -> PathBuf {
    Path::new(ROOT).join("tests/learning")
}

fn judged(bench: &Bench, predictor: &dyn Predictor, window: &Window) -> Judged {
    let partition = bench.data.samples.partition(&Split::default(), window).unwrap();
    let (samples, task) = (&*bench.data.samples, Task::Prediction);
    judge(predictor, &Test { samples, task, windows: &partition.test, since_s: &[], sampled: Some(&[]) })
        .unwrap()
}

/// R2 of a modality at a horizon: the mean over its units.
fn r2(judged: &Judged, horizon: usize) -> f64 {
    let is_of_unit = |direction: harness_metrics::Direction| direction.name().starts_with("in ");
    let rows = judged.metrics.iter().filter(|row| (row.horizon, row.row.metric) == (horizon, Metric::R2));
    let rows: Vec<_> =
        rows.filter(|row| row.row.index.is_none() && row.row.direction.is_none_or(is_of_unit)).collect();
    let units: Vec<f64> = rows.iter().filter_map(|row| row.row.value).collect();
    assert!(!units.is_empty(), "R2 at {horizon}");
    units.iter().sum::<f64>() / units.len() as f64
}

#[test]
fn an_added_network_with_a_state_is_trained_and_judged() {
    let bench = Bench::new();
    let (Added { network, baseline, .. }, [parameters, _]) = Added::new(&bench);
    let arm: &[Modality] = &[Modality::ARM];
    let losses = fitted(&bench, network, &parameters, &WINDOW, [arm, arm], 150);
    assert!(losses[149] < 1e-3 * losses[0], "{losses:?}");
    // The parameters are those that were trained.
    let (added, [own, _]) = Added::new(&bench);
    own.iter().for_each(|(name, var)| var.set(&parameters[name]).unwrap());
    let trained = TrainedNetwork {
        data: &bench.data,
        network: added.network.detached(),
        input: arm,
        output: arm,
        window: &WINDOW,
        draws: 0,
        seed: 0,
    };
    let judged_of = |predictor: &dyn Predictor| judged(&bench, predictor, &WINDOW);
    let (network, zero) = (judged_of(&trained), judged_of(&*baseline));
    let horizons = WINDOW.horizons();
    assert_eq!(horizons, [1, 2, 5]);
    let samples = &*bench.data.samples;
    let persistence = judged_of(&Persistence { samples, modality: Modality::ARM, horizons: &horizons });
    // The arm moves by the actions alone, so their sum tells its position at any horizon.
    for &horizon in &horizons {
        assert!(r2(&network, horizon) > 0.999, "{horizon}: {}", r2(&network, horizon));
        assert!(r2(&zero, horizon) <= 0.0, "{horizon}: {}", r2(&zero, horizon));
    }
    assert!(r2(&persistence, 5) < r2(&persistence, 1) && r2(&persistence, 1) < 0.999);
    // Every sample has a latent state, but only those of the dataset.
    let latents = Latents::of(&*added.network, &bench.data, arm, &WINDOW).unwrap();
    assert!(latents.rows(&[Sample::at(1)]).is_ok() && latents.rows(&[Sample::at(48)]).is_err());
}

#[test]
fn drawn_latent_states_give_a_distribution_that_depends_on_no_other_window() {
    let bench = Bench::new();
    let (data, window) = (&bench.data, &Window::TRANSITION);
    let output = &OUTPUT[..2];
    let network = bench.architecture().network(&mut Parameters::new(), &mut random(3), &Device::Cpu).unwrap();
    let predicted = |draws: usize, seed: u64, at: &[Sample]| {
        let network = network.detached();
        let trained = TrainedNetwork { data, network, input: &INPUT, output, window, draws, seed };
        let mut found = Vec::new();
        let mut keep = |predicted: &harness_judge::Predicted| {
            let width = predicted.values.len() / at.len();
            let last = (at.len() - 1) * width;
            let members = predicted.ensemble.as_ref().map(|all| {
                let of = |share| (0..width).map(|value| all.at(last + value).quantile(share)).collect();
                [0.1, 0.5, 0.9].map(|share| -> Vec<f64> { of(share) })
            });
            found.push((predicted.values[last..].to_vec(), members));
            Ok(())
        };
        trained.predict(at, &mut keep).unwrap();
        found
    };
    let together = [Sample::at(1), Sample::at(2), Sample::at(14)];
    let drawn = predicted(50, 0, &together);
    assert_eq!(drawn, predicted(50, 0, &together[2..]), "of one window alone");
    assert_ne!(drawn, predicted(50, 1, &together), "of another seed");
    for (_, members) in &drawn {
        let [low, median, high] = members.as_ref().expect("there are members");
        assert!(
            low.iter().zip(median).zip(high).all(|((low, median), high)| low <= median && median <= high)
        );
        assert!(low.iter().zip(high).any(|(low, high)| low < high), "the draws differ");
    }
    assert!(predicted(0, 0, &together).iter().all(|(_, members)| members.is_none()), "without draws");
}

#[test]
fn a_rollout_of_some_steps_equals_single_steps() {
    let mut bench = Bench::new();
    bench.training.epochs = 1;
    // All inputs are among the outputs, so this network can predict from its own predictions.
    let both: &[Modality] = &[Modality::PROPRIOCEPTION];
    let architecture = Architecture { input: both.to_vec(), output: both.to_vec(), ..bench.architecture() };
    let network = architecture.network(&mut Parameters::new(), &mut random(3), &Device::Cpu).unwrap();
    let window = Window { context: 1, horizon: 3, ..Window::TRANSITION };
    let at = [Sample::at(1), Sample::at(14)];
    let seen = bench.data.observation(&at, both).unwrap();
    let observed = |seen: &Observation| {
        let encoded = network.encode(seen, &mut Draw::Mean).unwrap();
        network.observe(None, &encoded, &mut Draw::Mean).unwrap().state
    };
    let mut state = observed(&seen);
    for step in 0..3 {
        let now: Vec<Sample> = at.iter().map(|sample| sample.after(step)).collect();
        let acted = network.act(&state, &bench.data.actions(&now).unwrap()).unwrap();
        let next = network.decode(&acted).unwrap();
        // One step at a time: the prediction is seen like an observation.
        let again =
            next.iter().map(|(modality, values)| (*modality, Value::Vector(values.clone()))).collect();
        state = observed(&again);
        if step == 2 {
            let trained = TrainedNetwork {
                data: &bench.data,
                network: network.detached(),
                input: both,
                output: both,
                window: &window,
                draws: 0,
                seed: 0,
            };
            let mut found = Vec::new();
            let mut keep = |predicted: &harness_judge::Predicted| {
                found.push((predicted.horizon, predicted.values.clone()));
                Ok(())
            };
            trained.predict(&at, &mut keep).unwrap();
            assert_eq!(found.iter().map(|(horizon, _)| *horizon).collect::<Vec<_>>(), [1, 2, 3]);
            let mut values = next[&both[0]].flatten_all().unwrap().to_vec1::<f32>().unwrap();
            bench.data.normalizers.modalities[&both[0]].denormalize(&mut values);
            assert_eq!(found[2].1, values);
        }
    }
}

#[test]
fn an_added_fusion_of_two_encoders_is_trained() {
    let bench = Bench::new();
    let (Added { fusion, .. }, [_, mut parameters]) = Added::new(&bench);
    let decoder = bench.architecture().decoder(&mut parameters, &mut random(2), &Device::Cpu).unwrap();
    let network = Box::new(Cvae {
        encoder: fusion,
        decoder,
        input: INPUT.to_vec(),
        latent: bench.architecture().latent,
        changes: BTreeMap::new(),
    });
    let before = bits(&parameters);
    let losses = fitted(&bench, network, &parameters, &Window::TRANSITION, [&INPUT, &OUTPUT], 12);
    assert!(losses[11] < 0.9 * losses[0], "{losses:?}");
    let after = bits(&parameters);
    let changed = before.iter().zip(&after).filter(|(before, after)| before != after).count();
    assert!(changed > before.len() / 2, "{changed} of {} parameters changed", before.len());
}

#[test]
fn added_predictions_of_another_program_are_judged() {
    let bench = Bench::new();
    let (Added { predictions, .. }, _) = Added::new(&bench);
    let mut rows = read_predicted(&predictions, 1).unwrap();
    let values = rows.remove(&None).unwrap().into_iter().map(|row| RecordedValue {
        modality: row.modality,
        episode: row.episode,
        sample: row.sample,
        horizon: row.horizon,
        index: row.index,
        value: row.value,
    });
    let window = Window::TRANSITION;
    let (samples, windows) = (&*bench.data.samples, &bench.partition.test);
    let asked = Asked { outputs: &[Modality::ARM], horizons: &[1] };
    let recorded = Recorded::new("constant", samples, windows, asked, values).unwrap();
    let found = judged(&bench, &recorded, &window);
    // All values in the file are 0.
    let zeros = BTreeMap::from([((Modality::ARM, 1), vec![0.0; windows.len() * ARM_JOINTS])]);
    let zeros = Recorded::of_windows("zero", samples, windows, asked, zeros).unwrap();
    let zero = judged(&bench, &zeros, &window);
    let numbers = |judged: &Judged| judged.metrics.iter().map(|row| row.row.clone()).collect::<Vec<_>>();
    assert_eq!(numbers(&found), numbers(&zero));
    assert!(found.metrics.iter().all(|row| row.model == "constant"));
    assert!(r2(&found, 1) < 0.0);
}

#[test]
fn recorded_predictions_get_the_metrics_of_their_network() {
    let bench = Bench::new();
    let (_, parameters) = bench.train_undisturbed(0);
    let mut own = Parameters::new();
    let network = bench.architecture().network(&mut own, &mut random(0), &Device::Cpu).unwrap();
    own.iter().for_each(|(name, var)| var.set(&parameters[name]).unwrap());
    let output = &OUTPUT[..2];
    let (data, window) = (&bench.data, &Window::TRANSITION);
    let trained = TrainedNetwork {
        data,
        network: network.detached(),
        input: &INPUT,
        output,
        window,
        draws: 0,
        seed: 0,
    };
    let expected = judged(&bench, &trained, window);
    let value = |row: &PredictionRow| RecordedValue {
        modality: row.modality,
        episode: row.episode as usize,
        sample: row.sample as usize,
        horizon: row.horizon as usize,
        index: row.index as usize,
        value: row.predicted,
    };
    let mut values: Vec<RecordedValue> = expected.predictions.iter().map(value).collect();
    values.reverse();
    let (samples, windows) = (&*bench.data.samples, &bench.partition.test);
    let asked = Asked { outputs: output, horizons: &[1] };
    let recorded = Recorded::new("mine", samples, windows, asked, values.iter().copied()).unwrap();
    let found = judged(&bench, &recorded, window);
    assert!(found.metrics.iter().all(|row| row.model == "mine"));
    let numbers = |judged: &Judged| judged.metrics.iter().map(|row| row.row.clone()).collect::<Vec<_>>();
    assert_eq!(numbers(&found), numbers(&expected));

    let refused = |change: &dyn Fn(&mut Vec<RecordedValue>)| {
        let mut values = values.clone();
        change(&mut values);
        Recorded::new("mine", samples, windows, asked, values).map(|_| ()).unwrap_err().to_string()
    };
    let first = values[0];
    assert!(refused(&|values| values.truncate(values.len() - 1)).ends_with("is missing"));
    assert!(refused(&|values| values.push(first)).contains("it occurs twice"));
    assert!(refused(&|values| values[0].value = f32::NAN).contains("the value is not finite"));
    assert!(refused(&|values| values[0].index = 20).contains("no such element"));
    assert!(refused(&|values| values[0].episode = 0).contains("no test window predicts it"));
    assert!(refused(&|values| values[0].sample = 100).contains("no test window predicts it"));
    // The sample 2 ahead of the last one would be in another episode.
    let further = |values: &mut Vec<RecordedValue>| {
        values.iter_mut().filter(|value| value.sample > 2).for_each(|value| value.horizon = 2)
    };
    assert!(refused(&further).contains("nothing asks for predictions of"));
    assert_eq!(Recorded::new("mine", samples, windows, asked, []).map(|_| ()), Err(RecordedError::Empty));
}

/// The files of Rust below a folder that contain a word.
fn files_with(folder: &Path, word: &str) -> Vec<String> {
    fn add(folder: &Path, word: &str, found: &mut Vec<std::path::PathBuf>) {
        for path in std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
            let is_letter = |letter: char| letter.is_alphanumeric() || letter == '_';
            let has = |text: String| text.split(|letter| !is_letter(letter)).any(|part| part == word);
            if path.is_dir() {
                add(&path, word, found);
            } else if path.extension().is_some_and(|ending| ending == "rs")
                && has(std::fs::read_to_string(&path).unwrap())
            {
                found.push(path);
            }
        }
    }
    let mut found = Vec::new();
    add(folder, word, &mut found);
    found.sort();
    found.iter().map(|file| file.strip_prefix(folder).unwrap().display().to_string()).collect()
}

#[test]
fn an_addition_takes_one_file_and_one_registration() {
    let tests = tests();
    for (name, file) in
        [("Integrator", "toy_network.rs"), ("MeanOfBoth", "toy_fusion.rs"), ("Zero", "toy_baseline.rs")]
    {
        assert_eq!(files_with(&tests, name), ["additions.rs", file], "{name}");
        let registrations = include_str!("additions.rs").matches(&format!("::{name}")).count();
        assert_eq!(registrations, 1, "{name}");
    }
    let predictions = format!("toy_{}.csv", "predictions");
    assert!(tests.join(&predictions).exists());
    assert_eq!(include_str!("additions.rs").matches(&predictions).count(), 1);
    // What the harness itself has is in its own file, in the list of its folder, and where it is chosen.
    let harness = Path::new(ROOT).join("harness");
    for (name, files) in [
        ("Cvae", &["learning/network/cvae.rs", "learning/network/mod.rs"][..]),
        ("LateEncoder", &["learning/network/encoder.rs"]),
        ("Persistence", &["experiment/evaluate.rs", "judge/lib.rs", "judge/persistence.rs"]),
        (
            "Ridge",
            &[
                "experiment/evaluate.rs",
                "experiment/recorded.rs",
                "judge/lib.rs",
                "judge/ridge.rs",
                "metrics/baselines.rs",
            ],
        ),
    ] {
        assert_eq!(files_with(&harness, name), files, "{name}");
    }
}

#[test]
fn a_numeric_setting_takes_at_most_four_files() {
    let root = Path::new(ROOT);
    // Declared once; a rule that depends on other settings, if there is one; used. The schema is generated.
    for (name, files) in [
        ("memory_samples", &["learning/network/window.rs", "spec/lib.rs", "spec/types.rs"][..]),
        ("burn_in", &["learning/objective.rs", "spec/types.rs", "spec/validate.rs"]),
        ("rollout_stride", &["learning/objective.rs", "spec/types.rs"]),
    ] {
        assert_eq!(files_with(&root.join("harness"), name), files, "{name}");
        let schema = std::fs::read_to_string(root.join("experiments/schema.json")).unwrap();
        assert_eq!(schema.matches(&format!("\"{name}\": {{")).count(), 1, "{name}");
    }
}
