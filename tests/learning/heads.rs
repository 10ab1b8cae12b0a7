//! Networks that predict distributions.

use super::changes::{MEMORIES, WINDOW, bench, loss_and_score, predicting, received, trained};
use super::*;
use harness_judge::{Predicted, Predictor};
use harness_learning::levels::{PARTS, levels, share_below, shares};
use harness_learning::network::{Decoder, Hurdle, Spread};
use harness_learning::predict::TrainedNetwork;
use harness_metrics::Ensemble;
use harness_ops::{
    cross_entropy, gaussian_crps, softplus, truncated_laplace_crps, truncated_laplace_mean,
    truncated_laplace_quantiles,
};
use harness_spec::Family;
use statrs::distribution::{ContinuousCDF, Laplace, Normal};

fn row(values: &[f32]) -> Tensor {
    Tensor::new(values, &Device::Cpu).unwrap()
}

/// The continuous ranked probability score by its definition: the integral of the squared difference between the
/// cumulative distribution function and the step at the target, as a sum.
fn crps_of(cdf: impl Fn(f64) -> f64, target: f64, range: [f64; 2]) -> f64 {
    const STEPS: usize = 200_000;
    let [low, high] = range;
    let step = (high - low) / STEPS as f64;
    let at = |index: usize| low + (index as f64 + 0.5) * step;
    (0..STEPS).map(|index| (cdf(at(index)) - f64::from(u8::from(at(index) >= target))).powi(2) * step).sum()
}

#[test]
fn the_score_of_a_gaussian_is_its_crps() {
    let (means, scales, targets) =
        ([0.0, 1.0, 0.3, 0.0, -2.0], [1.0, 0.5, 2.0, 0.01, 1.5], [0.0, -2.0, 0.9, 5.0, -2.5]);
    let found = gaussian_crps(&row(&means), &row(&scales), &row(&targets)).unwrap().to_vec1::<f32>().unwrap();
    for (index, found) in found.into_iter().enumerate() {
        let [mean, scale, target] = [means[index], scales[index], targets[index]].map(f64::from);
        let normal = Normal::new(mean, scale).unwrap();
        let expected = crps_of(|x| normal.cdf(x), target, [-20.0, 20.0]);
        assert!((f64::from(found) - expected).abs() < 2e-4 * expected, "{index}: {found} {expected}");
    }
    // A distribution without width is a point, whose CRPS is its absolute error.
    let point = gaussian_crps(&row(&[1.5]), &row(&[1e-6]), &row(&[-2.0])).unwrap();
    assert!((point.to_vec1::<f32>().unwrap()[0] - 3.5).abs() < 1e-5);
}

#[test]
fn the_score_of_a_truncated_laplace_is_its_crps() {
    const LEAST: f64 = 0.05;
    let (means, scales, targets) = ([0.05, 0.2, 1.0, 3.0], [1.0, 2.0, 0.5, 0.5], [0.06, 3.0, 0.4, 2.0]);
    let least = Tensor::new(LEAST as f32, &Device::Cpu).unwrap();
    let (mean, scale) = (row(&means), row(&scales));
    let found = truncated_laplace_crps(&mean, &scale, &least, &row(&targets)).unwrap();
    let quantiles = |probability| {
        let quantiles = truncated_laplace_quantiles(&mean, &scale, &least, probability).unwrap();
        quantiles.map(|quantiles| quantiles.to_vec1::<f32>().unwrap())
    };
    let quantiles = [0.5, 0.95].map(|probability| (probability, quantiles(probability)));
    let found_means = truncated_laplace_mean(&mean, &scale, &least).unwrap().to_vec1::<f32>().unwrap();
    for (index, found) in found.to_vec1::<f32>().unwrap().into_iter().enumerate() {
        let [mean, scale, target] = [means[index], scales[index], targets[index]].map(f64::from);
        let laplace = Laplace::new(mean, scale).unwrap();
        let below = laplace.cdf(LEAST);
        let cdf = |x: f64| (laplace.cdf(x) - below).max(0.0) / (1.0 - below);
        for (probability, [upper, lower]) in &quantiles {
            let [upper, lower] = [upper, lower].map(|quantiles| cdf(f64::from(quantiles[index])));
            assert!(
                (upper - probability).abs() < 1e-6 && (lower - (1.0 - probability)).abs() < 1e-6,
                "{index}"
            );
        }
        let expected = crps_of(cdf, target, [LEAST, 30.0]);
        assert!((f64::from(found) - expected).abs() < 1e-3 * expected, "{index}: {found} {expected}");
        // The mean is the bound plus the integral of the probability of a higher value, a CRPS without its square.
        let expected: f64 = LEAST
            + (0..100_000).map(|i| (1.0 - cdf(LEAST + (f64::from(i) + 0.5) * 3e-4)) * 3e-4).sum::<f64>();
        assert!((f64::from(found_means[index]) - expected).abs() < 1e-4, "{index}: {expected}");
    }
}

#[test]
fn the_gradients_of_scores_are_finite_differences() {
    let mut random = random(8);
    let target = normal(&mut random, &[6, 3]);
    let arguments = [variable(&mut random, &[6, 3]), variable(&mut random, &[6, 3])];
    assert_gradients(&arguments, |args| gaussian_crps(&args[0], &(softplus(&args[1])? + 1e-3)?, &target));
    let least = Tensor::new(&[-1.0f32, 0.0, 0.1], &Device::Cpu).unwrap();
    let touches = target.gt(0.0).unwrap().to_dtype(candle_core::DType::F32).unwrap();
    let location = |raw: &Tensor| softplus(raw)?.broadcast_add(&least);
    assert_gradients(&arguments, |args| {
        let (location, scale) = (location(&args[0])?, (softplus(&args[1])? + 1e-3)?);
        let score = truncated_laplace_crps(&location, &scale, &least, &target)?;
        (score * &touches)? + cross_entropy(&args[0], &touches)?
    });
    assert_gradients(&arguments, |args| {
        truncated_laplace_mean(&location(&args[0])?, &(softplus(&args[1])? + 1e-3)?, &least)
    });
}

#[test]
fn softplus_neither_overflows_nor_vanishes() {
    let x = Var::new(&[-80.0f32, -1.0, 0.0, 1.0, 1e4], &Device::Cpu).unwrap();
    let found = softplus(&x).unwrap();
    let expected = [-80f64, -1.0, 0.0, 1.0].map(|x| x.exp().ln_1p());
    let values = found.to_vec1::<f32>().unwrap();
    assert!(values.iter().zip(expected).all(|(found, expected)| (f64::from(*found) - expected).abs() < 1e-6));
    assert_eq!(values[4], 1e4);
    let gradients = found.sum_all().unwrap().backward().unwrap().get(&x).unwrap().to_vec1::<f32>().unwrap();
    assert!(gradients[0].abs() < 1e-6 && gradients[2] == 0.5 && gradients[4] == 1.0, "{gradients:?}");
}

/// The distribution of a prediction.
fn distribution(prediction: &Predicted) -> Ensemble {
    prediction.ensemble.clone().expect("a distribution")
}

#[test]
fn the_loss_is_the_crps_of_the_judged_distributions() {
    for memory in MEMORIES {
        let crps = |found: &Ensemble, reference: &[f32], deviation: &[f32]| {
            let all = reference.iter().zip(deviation).enumerate();
            all.map(|(element, (reference, std))| found.at(element).crps(*reference) / f64::from(*std))
                .collect()
        };
        let (loss, expected) = loss_and_score(memory, Family::Gaussian, distribution, crps);
        // The judge has 100 quantiles.
        assert!((loss - expected).abs() < 5e-3 * expected, "{memory}: {loss} {expected}");
    }
}

#[test]
fn the_score_of_intervals_is_that_of_the_judged_distributions() {
    let (bench, network, _) = bench(Memory::None, Family::Gaussian);
    let (data, training) = (&bench.data, Training::default());
    let window = Window { horizon: 1, ..WINDOW };
    let objective = predicting(data, network, &window, &training);
    let at = &bench.partition.training[..40];
    let intervals = objective.intervals();
    let terms = intervals.terms(at, Draw::Mean).unwrap();
    let term = terms.iter().find(|term| term.name == Modality::ARM.name()).unwrap();
    let judged = trained(data, objective.network.detached(), &window);
    let found = &received(&judged, at, Modality::ARM, distribution)[&1];
    let deviation = &data.normalizers.changes[&Modality::ARM].std;
    let references = harness_samples::after(at, 1);
    let references = references.into_iter().flat_map(|at| data.samples.vector(Modality::ARM, at).to_vec());
    let mut sum = 0.0;
    for (index, reference) in references.map(f64::from).enumerate() {
        let [low, high] = [0.05, 0.95].map(|probability| found.at(index).quantile(probability));
        let outside = (low - reference).max(reference - high).max(0.0);
        sum += (high - low + 20.0 * outside) / f64::from(deviation[index % ARM_JOINTS]);
    }
    let (score, expected) = (term.value.to_scalar::<f32>().unwrap(), sum / (at.len() * ARM_JOINTS) as f64);
    assert!((f64::from(score) - expected).abs() < 0.02 * expected, "{score} {expected}");
}

#[test]
fn recalibration_finds_the_scale_and_the_probability_of_the_validation_samples() {
    // The intervals are best with a factor of 1.7 for the scales, and the loss with one of 0.6 for the logits.
    let bench = Bench::new();
    let architecture = Architecture {
        output: vec![FORCE],
        distributions: [(FORCE, Family::Hurdle)].into(),
        ..bench.architecture()
    };
    let mut parameters = Parameters::new();
    architecture.decoder(&mut parameters, &mut random(0), &Device::Cpu).unwrap();
    let of = |parameters: &Parameters| {
        parameters["decoder.vector.bias"].as_tensor().detach().copy().unwrap().to_vec1::<f32>().unwrap()
    };
    let before = of(&parameters);
    let (scale, logit) = (JOINTS, 2 * JOINTS);
    let found = |parameters: &Parameters| {
        let now = of(parameters);
        [f64::from(now[scale] - before[scale]), f64::from(now[logit] / before[logit]).ln()]
    };
    let mut scores = |score| {
        let [scale, logit] = found(&parameters);
        let score = match score {
            Score::Intervals => (scale - 1.7f64.ln()).powi(2),
            Score::Loss => (logit - 0.6f64.ln()).powi(2),
        };
        Ok([(FORCE.to_string(), score)].into())
    };
    architecture.recalibrate(&parameters, &mut scores).unwrap();
    let [scale, logit] = found(&parameters);
    assert!((scale - 1.7f64.ln()).abs() < 1e-3 && (logit - 0.6f64.ln()).abs() < 1e-3, "{scale} {logit}");
    // Without validation samples, and without contacts in them, nothing changes.
    let calibrated = of(&parameters);
    for scores in [BTreeMap::new(), [(FORCE.to_string(), 0.0)].into()] {
        architecture.recalibrate(&parameters, &mut |_| Ok(scores.clone())).unwrap();
        assert_eq!(of(&parameters), calibrated);
    }
}

#[test]
fn as_many_values_as_should_lie_below_recalibrated_quantiles() {
    for memory in [Memory::None, Memory::Gru] {
        let (bench, network, _) = bench(memory, Family::Gaussian);
        let at = &bench.partition.training;
        let families = [(Modality::ARM, Family::Gaussian)].into();
        let window = WINDOW;
        let predicted = trained(&bench.data, network.detached(), &window);
        let shares = levels(&predicted, &families, at).unwrap();
        let shares_of = &shares[&Modality::ARM];
        assert_eq!((shares_of[0], shares_of[PARTS]), (0.0, 1.0));
        let is_wrong = |(place, share): (usize, &f32)| (share - place as f32 / PARTS as f32).abs() > 0.05;
        assert!(shares_of.iter().enumerate().any(is_wrong), "{shares_of:?}");
        let data = bench.data.recalibrated(shares.clone());
        let recalibrated = trained(&data, network.detached(), &window);
        let mut below = vec![0.0; shares_of.len()];
        let mut count = 0.0;
        for part in at.chunks(40) {
            for (horizon, ensemble) in received(&recalibrated, part, Modality::ARM, distribution) {
                let samples = harness_samples::after(part, horizon);
                let values = samples.iter().flat_map(|at| data.samples.vector(Modality::ARM, *at));
                for (index, value) in values.enumerate() {
                    count += 1.0;
                    for (below, share) in below.iter_mut().zip(shares_of) {
                        let quantile = ensemble.at(index).quantile(f64::from(*share));
                        *below += f64::from(u8::from(f64::from(*value) < quantile));
                    }
                }
            }
        }
        for (below, share) in below[1..PARTS].iter().zip(&shares_of[1..PARTS]) {
            assert!((below / count - f64::from(*share)).abs() < 0.02, "{memory}: {} {share}", below / count);
        }
    }
}

#[test]
fn levels_move_the_force_given_a_contact_and_not_the_probability_of_one() {
    let mut bench = Bench::new();
    bench.training.distributions = [(FORCE, Family::Hurdle)].into();
    let network = bench.architecture().network(&mut Parameters::new(), &mut random(3), &Device::Cpu).unwrap();
    let (window, at) = (&Window::TRANSITION, &bench.partition.test[..3]);
    let predictions = |data: &NormalizedData| {
        let (network, output) = (network.detached(), &[FORCE]);
        let trained = TrainedNetwork { data, network, input: &INPUT, output, window, draws: 0, seed: 0 };
        received(&trained, at, FORCE, |all| (all.values.clone(), distribution(all))).remove(&1).unwrap()
    };
    // A value is below the network's quantile at p with the probability p².
    let squares = (0..=100).map(|place| (place as f32 / 100.0).powi(2)).collect();
    let data = bench.data.recalibrated([(FORCE, squares)].into());
    let ((before, predicted), (after, recalibrated)) = (predictions(&bench.data), predictions(&data));
    for index in 0..before.len() {
        let [old, new] = [&predicted, &recalibrated].map(|all| all.at(index));
        assert_eq!(old.above(0.05), new.above(0.05));
        let [old, new] = [old, new].map(|all| all.given_above(0.05).unwrap());
        let [expected, found] = [old.quantile(0.5f64.sqrt()), new.quantile(0.5)];
        assert!((found - expected).abs() < 0.03 * expected, "{index}: {found} {expected}");
        let mean = recalibrated.at(index).mean(f64::from) as f32;
        assert!((after[index] - mean).abs() < 1e-5 * mean && after[index] > 1.1 * before[index], "{index}");
    }
    // They are read from the description of the network.
    bench.data = data;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("network.safetensors");
    let normalizers = &bench.data.normalizers;
    checkpoint::save(&path, &Parameters::new(), normalizers, &bench.description()).unwrap();
    assert_eq!(checkpoint::open(&path).unwrap().1, **normalizers);
    // A few contacts say too little.
    let families = [(FORCE, Family::Hurdle)].into();
    let samples = Arc::new(walks(30, 12));
    let partition = samples.partition(&Split::default(), window).unwrap();
    let data = &NormalizedData::new(samples, normalizers.clone(), Action::Increment, Device::Cpu);
    let network = network.detached();
    let trained =
        TrainedNetwork { data, network, input: &INPUT, output: &[FORCE], window, draws: 0, seed: 0 };
    let found = |at| levels(&trained, &families, at).unwrap().len();
    assert_eq!([found(&partition.training[..4]), found(&partition.training)], [0, 1]);
}

#[test]
fn values_at_a_minimum_are_as_frequent_as_they_should_be() {
    // A force is 0 nine times out of ten. The network gives it the probabilities 0.2 to 0.6, and is too narrow above.
    let mut random = random(11);
    let mut draw = || f64::from(random.uniform(1, 0.5)[0]) + 0.5;
    let bounds: Vec<[f64; 2]> = (0..20_000)
        .map(|_| {
            let zero = 0.2 + 0.4 * draw();
            if draw() < 0.9 { [0.0, zero] } else { [zero + (1.0 - zero) * draw().sqrt(); 2] }
        })
        .collect();
    let shares = shares(&bounds);
    // Recalibrated, the expected place of each value is uniform.
    let below = |probability: f64| {
        let of = |[low, high]: &[f64; 2]| {
            let [low, high] = [low, high].map(|level| share_below(&shares, *level));
            if high > low {
                ((probability - low) / (high - low)).clamp(0.0, 1.0)
            } else {
                f64::from(u8::from(low < probability))
            }
        };
        bounds.iter().map(of).sum::<f64>() / bounds.len() as f64
    };
    for tenth in (1..10).map(|tenth| f64::from(tenth) / 10.0) {
        assert!((below(tenth) - tenth).abs() < 0.01, "{tenth}: {}", below(tenth));
    }
}

#[test]
fn drawn_values_have_the_spread_of_the_distribution() {
    let (bench, network, _) = bench(Memory::Gru, Family::Gaussian);
    let window = WINDOW;
    let mut trained = trained(&bench.data, network.detached(), &window);
    let at = &bench.partition.test[..2];
    let quantiles = received(&trained, at, Modality::ARM, distribution);
    trained.draws = 400;
    let draws = received(&trained, at, Modality::ARM, distribution);
    assert_eq!(received(&trained, &at[1..], Modality::ARM, distribution)[&2].at(0).quantile(0.3), {
        draws[&2].at(ARM_JOINTS).quantile(0.3)
    });
    for (horizon, value) in
        [1, 2, 5].into_iter().flat_map(|horizon| (0..6).map(move |value| (horizon, value)))
    {
        let width = |all: &Ensemble| {
            let [low, high] = all.at(value).interval(0.5);
            high - low
        };
        let ratio = width(&draws[&horizon]) / width(&quantiles[&horizon]);
        // The latent state is drawn as well.
        assert!((0.8..1.6).contains(&ratio), "{horizon} {value}: {ratio}");
    }
}

const FORCE: Modality = Modality::CONTACT_FORCE;

/// A decoder of forces whose last layer returns the same values for each link whatever it gets.
fn constant_decoder(bench: &Bench, family: Family, columns: &[f32]) -> Box<dyn Decoder> {
    let architecture =
        Architecture { output: vec![FORCE], distributions: [(FORCE, family)].into(), ..bench.architecture() };
    let mut parameters = Parameters::new();
    let architecture = architecture.scaled(&bench.data.normalizers);
    let decoder = architecture.decoder(&mut parameters, &mut random(0), &Device::Cpu).unwrap();
    let weight = &parameters["decoder.vector.weight"];
    weight.set(&weight.zeros_like().unwrap()).unwrap();
    let bias = columns.iter().flat_map(|column| [*column; JOINTS]).collect::<Vec<_>>();
    parameters["decoder.vector.bias"].set(&row(&bias)).unwrap();
    decoder
}

#[test]
fn a_hurdle_with_a_certain_contact_is_a_laplace_distribution() {
    let bench = Bench::new();
    let scale = &bench.data.normalizers.modalities[&FORCE];
    let mut forces: Vec<f32> = (0..JOINTS).map(|link| 1.0 + link as f32).collect();
    scale.normalize(&mut forces);
    let target = Tensor::from_vec(forces, (1, JOINTS), &Device::Cpu).unwrap();
    let values: Observation = [(FORCE, Value::Vector(target.clone()))].into_iter().collect();
    let (latent, action) =
        (row(&[0.0; 3]).unsqueeze(0).unwrap(), row(&[0.0; ARM_JOINTS]).unsqueeze(0).unwrap());
    let decoder = constant_decoder(&bench, Family::Hurdle, &[30.0, 0.3, 60.0]);
    let targets =
        Targets { values: &values, losses: &BTreeMap::new(), parts: 1, score: Score::Loss, added: None };
    let loss = decoder.losses(&latent, Some(&action), targets).unwrap().remove(0).value;
    let mean = decoder.decode(&latent, Some(&action)).unwrap().remove(&FORCE).unwrap();
    let Spread { scale: deviation, hurdle } =
        decoder.spreads(&latent, Some(&action)).unwrap().remove(&FORCE).unwrap();
    let Hurdle { location, touches } = hurdle.unwrap();
    let all = mean.ones_like().unwrap();
    assert_close(&mean, &(&all * 30.0).unwrap(), 1e-6, "the mean");
    assert_close(&location, &mean, 1e-6, "the location");
    assert_close(&deviation, &(&all * (0.3f64.exp() + 1e-3)).unwrap(), 1e-6, "the scale");
    assert_close(&touches, &all, 0.0, "the probability of a contact");
    let z = ((target - mean).unwrap() / &deviation).unwrap().abs().unwrap();
    let score = (&z + z.neg().unwrap().exp().unwrap()).unwrap();
    let expected = (((score - 0.75).unwrap() * deviation).unwrap()).mean_all().unwrap();
    assert_close(&loss, &expected.unsqueeze(0).unwrap(), 1e-5, "the loss");
    // Without a contact, the loss is the cross-entropy alone, here of a probability of 1/2.
    let none = [(
        FORCE,
        Value::Vector({
            let mut zeros = vec![0.0; JOINTS];
            scale.normalize(&mut zeros);
            Tensor::from_vec(zeros, (1, JOINTS), &Device::Cpu).unwrap()
        }),
    )];
    let values: Observation = none.into_iter().collect();
    let targets =
        Targets { values: &values, losses: &BTreeMap::new(), parts: 1, score: Score::Loss, added: None };
    let decoder = constant_decoder(&bench, Family::Hurdle, &[30.0, 0.3, 0.0]);
    let loss = decoder.losses(&latent, Some(&action), targets).unwrap().remove(0).value;
    assert!((scalar(&loss.get(0).unwrap()).unwrap() - 2f64.ln()).abs() < 1e-6);
}

#[test]
fn the_quantiles_of_a_hurdle_have_its_mean_and_its_mass_at_zero() {
    let mut bench = Bench::new();
    bench.training.distributions = [(FORCE, Family::Hurdle)].into();
    let network = bench.architecture().network(&mut Parameters::new(), &mut random(3), &Device::Cpu).unwrap();
    let (data, window, output) = (&bench.data, &Window::TRANSITION, &[FORCE]);
    let at = &bench.partition.test[..3];
    let network_of = || network.detached();
    let judged =
        TrainedNetwork { data, network: network_of(), input: &INPUT, output, window, draws: 0, seed: 0 };
    let seen = data.observation(at, &INPUT).unwrap();
    let encoded = network.encode(&seen, &mut Draw::Mean).unwrap();
    let state = network.observe(None, &encoded, &mut Draw::Mean).unwrap().state;
    let state = network.act(&state, &data.actions(at).unwrap()).unwrap();
    let touches = network.spreads(&state).unwrap().remove(&FORCE).unwrap().hurdle.unwrap().touches;
    let touches = touches.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let mut keep = |Predicted { values, ensemble, .. }: &Predicted| {
        let ensemble = ensemble.as_ref().unwrap();
        for (index, (value, touches)) in values.iter().zip(&touches).enumerate() {
            let distribution = ensemble.at(index);
            assert!((distribution.above(0.05) - f64::from(*touches)).abs() <= 0.01, "{index}");
            let mean = distribution.mean(f64::from);
            assert!((mean - f64::from(*value)).abs() < 0.01 * mean, "{index}: {mean} {value}");
            assert_eq!(distribution.quantile(0.0), 0.0);
        }
        Ok(())
    };
    judged.predict(at, &mut keep).unwrap();
}
