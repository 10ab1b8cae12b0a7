//! Networks with memory: the recurrent unit, gradients through time, states from rest, and what a memory is good for.

use super::*;
use harness_judge::{MetricRow, Persistence, Predictor, Test, judge};
use harness_learning::network::{Network as Predicting, State};
use harness_learning::ops::gru;
use harness_learning::predict::{Latents, TrainedNetwork};
use harness_metrics::Metric;
use harness_spec::WindowStart;

const ARM: [Modality; 1] = [Modality::ARM];
const ANGLES: [Modality; 1] = [Modality::PROPRIOCEPTION];

/// Walks of the arm, and a network that sees joint angles, which say nothing about the arm.
fn bench(memory: Memory) -> (Bench, Architecture) {
    let samples = walks(60, 16);
    let partition = samples.partition(&Split::default(), Window::TRANSITION).unwrap();
    let mut bench = Bench::new();
    let modalities = [Modality::ARM, Modality::PROPRIOCEPTION];
    let scaling = |modality| (modality, World::paper(Scenario::EMPTY).scaling(modality).unwrap());
    let scalings = modalities.into_iter().map(scaling).collect();
    let normalizers = Normalizers::fit(&samples, &partition.training, &scalings, Action::Increment);
    bench.data.samples = Arc::new(samples);
    bench.data.normalizers = Arc::new(normalizers);
    bench.network = Network { hidden: vec![16], memory, ..network(16, 2) };
    let architecture = Architecture { input: ANGLES.to_vec(), output: ARM.to_vec(), ..bench.architecture() };
    (bench, architecture)
}

fn built(architecture: &Architecture) -> (Box<dyn Predicting>, Parameters) {
    let mut parameters = Parameters::new();
    let network = architecture.network(&mut parameters, &mut random(4), &Device::Cpu).unwrap();
    (network, parameters)
}

fn objective<'a>(
    bench: &'a Bench,
    network: Box<dyn Predicting>,
    window: Window,
    losses: &'a BTreeMap<Modality, Loss>,
    weights: &'a BTreeMap<Modality, f64>,
) -> Prediction<'a> {
    let data = &bench.data;
    Prediction {
        data,
        network,
        window,
        input: &ANGLES,
        output: &ARM,
        kl_weight: 0.01,
        losses,
        loss_weights: weights,
    }
}

#[test]
fn a_gated_recurrent_unit_is_that_of_its_formula() {
    let mut random = random(7);
    let (batch, width) = (3, 5);
    let given =
        [[batch, 3 * width], [batch, 3 * width], [batch, width]].map(|shape| variable(&mut random, &shape));
    let [input, hidden, state] = given.each_ref().map(|var| var.as_tensor().to_vec2::<f32>().unwrap());
    let next = gru(&given[0], &given[1], &given[2]).unwrap().to_vec2::<f32>().unwrap();
    let logistic = |x: f64| 1.0 / (1.0 + (-x).exp());
    for row in 0..batch {
        for unit in 0..width {
            let of = |gates: &[Vec<f32>], part: usize| f64::from(gates[row][part * width + unit]);
            let reset = logistic(of(&input, 0) + of(&hidden, 0));
            let update = logistic(of(&input, 1) + of(&hidden, 1));
            let candidate = (of(&input, 2) + reset * of(&hidden, 2)).tanh();
            let expected = (1.0 - update) * candidate + update * f64::from(state[row][unit]);
            assert!((f64::from(next[row][unit]) - expected).abs() < 1e-6, "row {row}, unit {unit}");
        }
    }
    assert_gradients(&given, |given| gru(&given[0], &given[1], &given[2]));
    // Large values saturate the gates.
    let large = Tensor::full(200f32, (1, 3), &Device::Cpu).unwrap();
    let one = Tensor::ones((1, 1), candle_core::DType::F32, &Device::Cpu).unwrap();
    let kept = gru(&large, &large, &one).unwrap().to_vec2::<f32>().unwrap();
    assert_eq!(kept, [[1.0]]);
    let wide = Tensor::zeros((1, 4), candle_core::DType::F32, &Device::Cpu).unwrap();
    assert!(gru(&wide, &large, &one).is_err());
}

#[test]
fn gradients_through_time_are_finite_differences() {
    let (bench, architecture) = bench(Memory::Gru);
    let (network, parameters) = built(&architecture);
    let window = Window { context: 6, horizon: 4, ..Window::TRANSITION };
    let (losses, weights) = (BTreeMap::new(), BTreeMap::new());
    let objective = objective(&bench, network, window, &losses, &weights);
    let at = [Sample::at(6), Sample::at(24)];
    let total = || {
        let terms = objective.terms(&at, Draw::Mean).unwrap();
        let values = terms.iter().map(|term| (&term.value * term.weight).unwrap());
        values.reduce(|sum, value| (sum + value).unwrap()).unwrap()
    };
    let gradients = total().backward().unwrap();
    let mut random = random(11);
    for (name, var) in &parameters {
        let direction = normal(&mut random, var.dims());
        // The posterior of the encoder without memory is not used, and has no gradient.
        let slope = dot(gradients.get(var).unwrap_or_else(|| panic!("{name} has no gradient")), &direction);
        let before = var.as_tensor().copy().unwrap();
        let moved = |step: f64| {
            var.set(&(&before + (&direction * step).unwrap()).unwrap()).unwrap();
            let value = scalar(&total()).unwrap();
            var.set(&before).unwrap();
            value
        };
        let agrees = [3e-3, 1e-3, 1e-2].into_iter().any(|step| {
            let difference = (moved(step) - moved(-step)) / (2.0 * step);
            (difference - slope).abs() < 2e-3 + 0.03 * slope.abs()
        });
        assert!(agrees, "{name}: {slope}");
    }
}

/// The state of a sample, step by step from an earlier one.
fn stepped(bench: &Bench, network: &dyn Predicting, first: usize, present: usize) -> State {
    let mut state = network.start(1, &Device::Cpu).unwrap();
    for now in (first..=present).map(|place| [Sample::at(place)]) {
        let seen = bench.data.observation(&now, &ANGLES).unwrap();
        let encoded = network.encode(&seen, &mut Draw::Mean).unwrap();
        let seen = network.observe(state.as_ref(), &encoded, &mut Draw::Mean).unwrap().state;
        if now[0].index() == present {
            return seen;
        }
        state = Some(network.act(&seen, &bench.data.actions(&now).unwrap()).unwrap());
    }
    unreachable!("the present sample is in the range")
}

fn close(found: &Tensor, expected: &Tensor) -> bool {
    let difference = (found - expected).unwrap().abs().unwrap().max_all().unwrap();
    scalar(&difference).unwrap() < 1e-5
}

#[test]
fn states_are_those_of_single_steps_from_their_start() {
    let (bench, architecture) = bench(Memory::Gru);
    let (network, _) = built(&architecture);
    let data = &bench.data;
    for (start, context) in [(WindowStart::Random, 5), (WindowStart::Rest, 5)] {
        let window = Window { context, start, horizon: 3 };
        let latents = Latents::of(&*network, data, &ANGLES, window).unwrap();
        for present in [20, 31] {
            // The second episode has the samples 16 to 31.
            let first = if start == WindowStart::Rest { 16 } else { present + 1 - context };
            let expected = stepped(&bench, &*network, first, present).latent;
            assert!(close(&latents.rows(&[Sample::at(present)]).unwrap(), &expected), "{start} {present}");
        }
        // The first samples of an episode have a shorter context.
        let second = latents.rows(&[Sample::at(17)]).unwrap();
        assert!(close(&second, &stepped(&bench, &*network, 16, 17).latent));
        // A prediction of three samples is three single steps, whatever other windows are predicted with it.
        let trained =
            TrainedNetwork { data, network: network.detached(), input: &ANGLES, output: &ARM, window };
        let predicted = |at: &[Sample]| {
            let mut found = Vec::new();
            let mut keep = |predicted: &harness_judge::Predicted| {
                found.push(predicted.values[predicted.values.len() - ARM_JOINTS..].to_vec());
                Ok(())
            };
            trained.predict(at, &mut keep).unwrap();
            found
        };
        let first = if start == WindowStart::Rest { 16 } else { 20 };
        let mut state = stepped(&bench, &*network, first, 24);
        let mut expected = Vec::new();
        for step in 0..3 {
            state = network.act(&state, &data.actions(&[Sample::at(24 + step)]).unwrap()).unwrap();
            let mut values =
                network.decode(&state).unwrap()[&Modality::ARM].flatten_all().unwrap().to_vec1().unwrap();
            data.normalizers.modalities[&Modality::ARM].denormalize(&mut values);
            expected.push(values);
        }
        for at in [vec![Sample::at(24)], vec![Sample::at(6), Sample::at(21), Sample::at(24)]] {
            for (found, expected) in predicted(&at).iter().zip(&expected) {
                let error =
                    found.iter().zip(expected).map(|(a, b): (&f32, &f32)| (a - b).abs()).fold(0.0, f32::max);
                assert!(error < 1e-5, "{start} {at:?}: {error}");
            }
        }
    }
}

/// Trains a network with or without memory, and returns its R2 of the arm at 1 and at 3 samples ahead, and that of
/// persistence.
fn r2_of_arm(memory: Memory) -> [[f64; 2]; 2] {
    let (bench, architecture) = bench(memory);
    let (network, parameters) = built(&architecture);
    let horizon = if memory == Memory::None { 1 } else { 3 };
    let window = Window { context: 12, start: WindowStart::Rest, horizon };
    let training = Training {
        epochs: 150,
        learning_rate: 5e-3,
        patience: None,
        batch_size: 128,
        kl_weight: 1e-4,
        ..Training::default()
    };
    let weights = BTreeMap::new();
    let objective =
        Prediction { kl_weight: 1e-4, ..objective(&bench, network, window, &training.losses, &weights) };
    let partition = &bench.data.samples.partition(&Split::default(), window).unwrap();
    let (state, progress) = (&StateFile::none(), &harness_shared::progress::Silent);
    let task = Task::Prediction;
    let fit = Fit { task, training: &training, seed: 0, partition, state, progress, log: &|_| () };
    fit.run(&objective, &parameters).unwrap();
    let (data, samples) = (&bench.data, &*bench.data.samples);
    let network = objective.network.detached();
    let trained = TrainedNetwork { data, network, input: &ANGLES, output: &ARM, window };
    let horizons = window.horizons();
    let persistence = Persistence { samples, modality: Modality::ARM, horizons: &horizons };
    let models: [&dyn Predictor; 2] = [&trained, &persistence];
    models.map(|model| {
        let judged =
            judge(model, &Test { samples, task, windows: &partition.test, sampled: Some(&[]) }).unwrap();
        [1, horizon].map(|horizon| {
            let is_whole = |row: &&MetricRow| {
                let found = (row.horizon, row.row.metric, row.row.index, row.row.direction.is_some());
                found == (horizon, Metric::R2, None, true)
            };
            let rows: Vec<f64> =
                judged.metrics.iter().filter(is_whole).filter_map(|row| row.row.value).collect();
            rows.iter().sum::<f64>() / rows.len() as f64
        })
    })
}

#[test]
fn a_memory_adds_up_the_actions_that_one_sample_lacks() {
    let [with, _] = r2_of_arm(Memory::Gru);
    let [without, _] = r2_of_arm(Memory::None);
    println!("R2 of the arm: with memory {with:?}, without {without:?}");
    assert!(with[0] > without[0] + 0.2 && with[1] > without[0] + 0.2, "with {with:?}, without {without:?}");
}
