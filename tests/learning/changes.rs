//! Networks that predict the change of an output since the present sample.

use super::*;
use harness_judge::{Persistence, Predicted, Predictor};
use harness_learning::network::Network as Predicting;
use harness_learning::predict::TrainedNetwork;
use harness_spec::WindowStart;

pub(super) const BOTH: [Modality; 2] = [Modality::PROPRIOCEPTION, Modality::ARM];
pub(super) const WINDOW: Window =
    Window { context: 4, start: WindowStart::Random, horizon: 5, since_s: Vec::new() };
pub(super) const MEMORIES: [Memory; 4] = [Memory::None, Memory::Window, Memory::Gru, Memory::Rssm];

/// The distributions of a change.
const FAMILIES: [Family; 2] = [Family::None, Family::Gaussian];

/// Walks of the arm, of which a network with this memory predicts the changes, beside the values of the joint angles.
pub(super) fn bench(memory: Memory, family: Family) -> (Bench, Box<dyn Predicting>, Parameters) {
    let mut bench = Bench::new();
    let samples = Arc::new(walks(30, 16));
    let partition = samples.partition(&Split::default(), &WINDOW).unwrap();
    let scaling = |modality| (modality, World::paper(Scenario::EMPTY).scaling(modality, &[]).unwrap());
    let scalings = BOTH.into_iter().map(scaling).collect();
    let normalizers = Normalizers::fit(&samples, &partition.training, &scalings, Action::Increment);
    let data = NormalizedData::new(samples, Arc::new(normalizers), Action::Increment, Device::Cpu);
    bench.data = data.predicting_changes([Modality::ARM].into_iter(), &partition.training, WINDOW.horizon);
    bench.partition = partition;
    bench.network = Network { hidden: vec![16], memory, memory_samples: 3, ..network(16, 2) };
    let (input, output, distributions) = (BOTH.to_vec(), BOTH.to_vec(), [(Modality::ARM, family)].into());
    let architecture = Architecture { input, output, distributions, ..bench.architecture() };
    let architecture = architecture.scaled(&bench.data.normalizers);
    let mut parameters = Parameters::new();
    let network = architecture.network(&mut parameters, &mut random(4), &Device::Cpu).unwrap();
    (bench, network, parameters)
}

pub(super) fn trained<'a>(
    data: &'a NormalizedData,
    network: Box<dyn Predicting>,
    window: &'a Window,
) -> TrainedNetwork<'a> {
    TrainedNetwork { data, network, input: &BOTH, output: &BOTH, window, draws: 0, seed: 0 }
}

/// What `pick` returns of the predictions of a modality, at each horizon.
pub(super) fn received<T>(
    predictor: &dyn Predictor,
    at: &[Sample],
    of: Modality,
    pick: impl Fn(&Predicted) -> T,
) -> BTreeMap<usize, T> {
    let mut found = BTreeMap::new();
    let mut receive = |prediction: &Predicted| {
        if prediction.modality == of {
            found.insert(prediction.horizon, pick(prediction));
        }
        Ok(())
    };
    predictor.predict(at, &mut receive).unwrap();
    found
}

/// What is predicted of a modality at each horizon.
fn predicted(predictor: &dyn Predictor, at: &[Sample], of: Modality) -> BTreeMap<usize, Vec<f32>> {
    received(predictor, at, of, |prediction| prediction.values.clone())
}

/// The prediction of both modalities from both.
pub(super) fn predicting<'a>(
    data: &'a NormalizedData,
    network: Box<dyn Predicting>,
    window: &'a Window,
    training: &'a Training,
) -> Prediction<'a> {
    Prediction { data, network, window, input: &BOTH, output: &BOTH, training, score: Score::Loss }
}

/// The loss of the arm on one window, in which a network with memory sees each sample once, and the mean of the scores
/// of all predictions in it. `score` returns one for each element, from what `pick` returns, the reference and the unit
/// of the change.
pub(super) fn loss_and_score<T>(
    memory: Memory,
    family: Family,
    pick: impl Fn(&Predicted) -> T,
    score: impl Fn(&T, &[f32], &[f32]) -> Vec<f64>,
) -> (f64, f64) {
    let (bench, network, _) = bench(memory, family);
    let data = &bench.data;
    let training = Training { batch_size: 8, ..Training::default() };
    let window = WINDOW;
    let objective = predicting(data, network, &window, &training);
    let at = &bench.partition.test[..1];
    let terms = objective.terms(at, Draw::Mean).unwrap();
    let term = terms.iter().find(|term| term.name == Modality::ARM.name()).unwrap();
    let deviation = &data.normalizers.changes[&Modality::ARM].std;
    let context = if memory == Memory::None { 1 } else { WINDOW.context };
    let mut scores = Vec::new();
    for (distance, ago) in (1..=WINDOW.horizon).flat_map(|one| (0..context).map(move |ago| (one, ago))) {
        let window = Window { context: context - ago, horizon: distance, ..WINDOW };
        let trained = trained(data, objective.network.detached(), &window);
        let present = [at[0].before(ago)];
        let found = received(&trained, &present, Modality::ARM, &pick).remove(&distance).unwrap();
        scores.extend(score(
            &found,
            data.samples.vector(Modality::ARM, present[0].after(distance)),
            deviation,
        ));
    }
    (f64::from(term.value.to_scalar::<f32>().unwrap()), scores.iter().sum::<f64>() / scores.len() as f64)
}

#[test]
fn the_divergences_of_many_windows_are_the_mean_over_all_batches() {
    for memory in MEMORIES {
        let (bench, network, _) = bench(memory, Family::None);
        let window = WINDOW;
        let trained = trained(&bench.data, network, &window);
        let at: Vec<Sample> =
            bench.partition.test.iter().copied().cycle().take(harness_judge::BATCH + 40).collect();
        let of = |at: &[Sample]| trained.divergences(at).unwrap();
        let (all, few, rest) = (of(&at), of(&at[..7]), of(&at[7..]));
        let expected = few
            .iter()
            .zip(&rest)
            .map(|(few, rest)| (7.0 * few + (at.len() - 7) as f64 * rest) / at.len() as f64);
        assert!(!all.is_empty(), "{memory:?}");
        for (found, expected) in all.iter().zip(expected) {
            assert!(
                (found - expected).abs() < 1e-6 * expected.abs().max(1.0),
                "{memory:?}: {found} {expected}"
            );
        }
    }
}

#[test]
fn a_network_whose_output_is_zero_predicts_what_persistence_does() {
    for (memory, family) in MEMORIES.into_iter().flat_map(|memory| FAMILIES.map(|family| (memory, family))) {
        let (bench, network, parameters) = bench(memory, family);
        for name in ["decoder.vector.weight", "decoder.vector.bias"] {
            parameters[name].set(&parameters[name].zeros_like().unwrap()).unwrap();
        }
        let (data, at) = (&bench.data, &bench.partition.test[..]);
        let window = WINDOW;
        let network = trained(data, network.detached(), &window);
        let horizons = WINDOW.horizons();
        let persistence =
            Persistence { samples: &data.samples, modality: Modality::ARM, horizons: &horizons };
        let expected = predicted(&persistence, at, Modality::ARM);
        assert!(expected.len() == 3 && expected[&5].len() == 3 * at.len());
        assert_eq!(predicted(&network, at, Modality::ARM), expected, "{memory}");
        // The other output is a value: its mean.
        let angles = predicted(&network, at, Modality::PROPRIOCEPTION);
        let mean = &data.normalizers.modalities[&Modality::PROPRIOCEPTION].mean;
        assert!(angles[&5].chunks(mean.len()).all(|row| row == mean), "{memory}");
    }
}

#[test]
fn the_loss_is_the_error_of_the_predictions_in_units_of_the_change() {
    for memory in MEMORIES {
        let error = |found: &Vec<f32>, reference: &[f32], deviation: &[f32]| {
            let all = found.iter().zip(reference).zip(deviation);
            all.map(|((a, b), std)| f64::from((a - b) / std).powi(2)).collect()
        };
        let values = |prediction: &Predicted| prediction.values.clone();
        let (loss, expected) = loss_and_score(memory, Family::None, values, error);
        assert!((loss - expected).abs() < 1e-4 * expected, "{memory}: {loss} {expected}");
    }
}

#[test]
fn gradients_reach_back_through_the_changes_that_were_predicted_before() {
    FAMILIES.into_iter().for_each(gradients_of);
}

fn gradients_of(family: Family) {
    let (bench, network, parameters) = bench(Memory::None, family);
    let training = Training::default();
    let window = WINDOW;
    let objective = predicting(&bench.data, network, &window, &training);
    let at = &bench.partition.training[..3];
    let loss = || {
        let terms = objective.terms(at, Draw::Mean).unwrap();
        terms.into_iter().find(|term| term.name == Modality::ARM.name()).unwrap().value
    };
    let gradients = loss().backward().unwrap();
    for name in ["decoder.vector.bias", "encoder.posterior.bias"] {
        let parameter = &parameters[name];
        let gradient = gradients.get(parameter).unwrap().to_vec1::<f32>().unwrap();
        let values = parameter.to_vec1::<f32>().unwrap();
        let mut largest = 0.0_f32;
        for index in 0..values.len() {
            let moved = |by: f32| {
                let mut values = values.clone();
                values[index] += by;
                parameter.set(&Tensor::new(values, &Device::Cpu).unwrap()).unwrap();
                f64::from(loss().to_scalar::<f32>().unwrap())
            };
            let difference = (moved(1e-2) - moved(-1e-2)) / 2e-2;
            moved(0.0);
            let error = (f64::from(gradient[index]) - difference).abs();
            assert!(
                error < 0.02 * difference.abs() + 2e-3,
                "{name} {index}: {} {difference}",
                gradient[index]
            );
            largest = largest.max(gradient[index].abs());
        }
        assert!(largest > 1e-3, "{name}: {largest}");
    }
}
