//! Networks with memory: the recurrent unit, gradients through time, states from rest, and what a memory is good for.

use super::*;
use harness_judge::{MetricRow, Persistence, Predictor, Test, judge};
use harness_learning::network::{Network as Predicting, Posterior, Seen, State};
use harness_learning::predict::{Latents, TrainedNetwork};
use harness_metrics::Metric;
use harness_ops::{
    Arithmetic, Gated, Sequences, StateSpace, TwoLayers, balanced_divergence, divergences, gru, rssm, sample,
    two_layers,
};
use harness_spec::WindowStart;

/// All kinds of memory.
const MEMORIES: [Memory; 3] = [Memory::Window, Memory::Gru, Memory::Rssm];
const ARM: [Modality; 1] = [Modality::ARM];
const ANGLES: [Modality; 1] = [Modality::PROPRIOCEPTION];

/// Walks of the arm, and a network that sees joint angles, which say nothing about the arm.
fn bench(memory: Memory) -> (Bench, Architecture) {
    let samples = walks(60, 16);
    let partition = samples.partition(&Split::default(), &Window::TRANSITION).unwrap();
    let mut bench = Bench::new();
    let modalities = [Modality::ARM, Modality::PROPRIOCEPTION];
    let scaling = |modality| (modality, World::paper(Scenario::EMPTY).scaling(modality, &[]).unwrap());
    let scalings = modalities.into_iter().map(scaling).collect();
    let normalizers = Normalizers::fit(&samples, &partition.training, &scalings, Action::Increment);
    bench.data.samples = Arc::new(samples);
    bench.data.normalizers = Arc::new(normalizers);
    bench.network = Network { hidden: vec![16], memory, memory_samples: 12, ..network(16, 2) };
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
    window: &'a Window,
    training: &'a Training,
) -> Prediction<'a> {
    Prediction {
        data: &bench.data,
        network,
        window,
        input: &ANGLES,
        output: &ARM,
        training,
        score: Score::Loss,
    }
}

/// Settings of a loss of which the divergence is a larger part than by default.
fn settings() -> Training {
    Training { kl_weight: 0.01, ..Training::default() }
}

#[test]
fn a_gated_recurrent_unit_is_that_of_its_formula() {
    // The units of 37 are two whole vectors of 16 and a part of one.
    for width in [5, 37] {
        assert_unit(width);
    }
    // Large values saturate the gates.
    let of = |value: f32, shape: &[usize]| Tensor::full(value, shape, &Device::Cpu).unwrap();
    let (weight, bias) = (of(0.0, &[3, 1]), of(200.0, &[3]));
    let kept = |input: &Tensor| {
        let [input_gates, hidden] = [0; 2].map(|_| Gated { weight: &weight, bias: &bias });
        gru(input, input_gates, hidden, &of(1.0, &[1, 1]), Arithmetic::best())
    };
    assert_eq!(kept(&of(1.0, &[2, 1])).unwrap().to_vec2::<f32>().unwrap(), [[1.0], [1.0]]);
    assert!(kept(&of(0.0, &[1, 2])).is_err());
}

/// Compares the states of a gated recurrent unit with its formula, and its gradients with finite differences.
fn assert_unit(width: usize) {
    let mut random = random(7);
    let (times, batch, columns) = (4, 3, 2);
    let gates = 3 * width;
    let shapes = [
        &[times * batch, columns][..],
        &[gates, columns],
        &[gates],
        &[gates, width],
        &[gates],
        &[batch, width],
    ];
    let given = shapes.map(|shape| variable(&mut random, shape));
    let units = |given: &[Tensor]| {
        let [input, hidden] = [1, 3].map(|first| Gated { weight: &given[first], bias: &given[first + 1] });
        gru(&given[0], input, hidden, &given[5], Arithmetic::best())
    };
    let states =
        units(&given.each_ref().map(|var| var.as_tensor().clone())).unwrap().to_vec2::<f32>().unwrap();
    let [inputs, input_weight, hidden_weight, start] =
        [0, 1, 3, 5].map(|index| given[index].to_vec2::<f32>().unwrap());
    let [input_bias, hidden_bias] = [2, 4].map(|index| given[index].to_vec1::<f32>().unwrap());
    let logistic = |x: f64| 1.0 / (1.0 + (-x).exp());
    let product = |weight: &[f32], values: &[f32], bias: f32| -> f64 {
        let products = weight.iter().zip(values).map(|(w, x)| f64::from(*w) * f64::from(*x));
        products.sum::<f64>() + f64::from(bias)
    };
    for row in 0..times * batch {
        let last = if row < batch { &start[row] } else { &states[row - batch] };
        for unit in 0..width {
            let gate = |part: usize| part * width + unit;
            let of = |part: usize| product(&input_weight[gate(part)], &inputs[row], input_bias[gate(part)]);
            let hidden = |part: usize| product(&hidden_weight[gate(part)], last, hidden_bias[gate(part)]);
            let reset = logistic(of(0) + hidden(0));
            let update = logistic(of(1) + hidden(1));
            let candidate = (of(2) + reset * hidden(2)).tanh();
            let expected = (1.0 - update) * candidate + update * f64::from(last[unit]);
            assert!((f64::from(states[row][unit]) - expected).abs() < 2e-6, "row {row}, unit {unit}");
        }
    }
    assert_gradients(&given, units);
}

#[test]
fn steps_of_a_state_space_model_are_those_of_single_ops() {
    // The units of 37 are two whole vectors of 16 and a part of one.
    for width in [5, 37] {
        for encoded in [0, 3] {
            [false, true].into_iter().for_each(|drawn| assert_state_space(width, encoded, drawn));
        }
    }
}

/// Compares the steps of a state-space model with a unit, two layers and a drawn state at each time, and its gradients
/// with finite differences. The distribution takes so many values of an encoded sample.
fn assert_state_space(width: usize, encoded: usize, drawn: bool) {
    let mut random = random(7);
    let (times, batch, action, latent, units) = (4, 3, 2, 3, 6);
    let (rows, gates) = (times * batch, 3 * width);
    let shapes = [
        &[rows, action][..],
        &[rows, encoded.max(1)],
        &[batch, width],
        &[batch, latent],
        &[gates, latent + action],
        &[gates],
        &[gates, width],
        &[gates],
        &[units, width + encoded],
        &[units],
        &[2 * latent, units],
        &[2 * latent],
    ];
    let noise = normal(&mut random, &[rows, latent]);
    // A log-variance grows with the latent state before it. With parameters of 1, the states would grow without bounds.
    let small = |shape: &[usize]| Var::from_tensor(&(normal(&mut random, shape) * 0.3).unwrap()).unwrap();
    let mut given = shapes.map(small).to_vec();
    let noise = drawn.then_some(&noise);
    fn model(given: &[Tensor]) -> StateSpace<'_> {
        let [input, hidden] = [4, 6].map(|first| Gated { weight: &given[first], bias: &given[first + 1] });
        let [hidden_weight, hidden_bias, weight, bias] = [8, 9, 10, 11].map(|index| &given[index]);
        StateSpace { input, hidden, distribution: TwoLayers { hidden_weight, hidden_bias, weight, bias } }
    }
    let seen = |given: &[Tensor]| (encoded > 0).then(|| given[1].clone());
    let steps = |given: &[Tensor]| {
        let encoded = seen(given);
        let sequences = Sequences { actions: &given[0], encoded: encoded.as_ref(), noise };
        let (memories, distributions) =
            rssm(&sequences, &model(given), &given[2], &given[3], Arithmetic::best())?;
        Tensor::cat(&[memories, distributions], 1)
    };
    let tensors: Vec<Tensor> = given.iter().map(|var| var.as_tensor().clone()).collect();
    let found = steps(&tensors).unwrap();
    let (mut memory, mut latents) = (tensors[2].clone(), tensors[3].clone());
    for first in (0..rows).step_by(batch) {
        let now = |tensor: &Tensor| tensor.narrow(0, first, batch).unwrap();
        let StateSpace { input, hidden, distribution } = model(&tensors);
        let inputs = Tensor::cat(&[&latents, &now(&tensors[0])], 1).unwrap();
        memory = gru(&inputs, input, hidden, &memory, Arithmetic::best()).unwrap();
        let joined = match seen(&tensors) {
            Some(encoded) => Tensor::cat(&[&memory, &now(&encoded)], 1).unwrap(),
            None => memory.clone(),
        };
        let distributions = two_layers(&joined, distribution, Arithmetic::best()).unwrap();
        latents = match noise {
            Some(noise) => sample(&distributions, &now(noise)).unwrap(),
            None => distributions.narrow(1, 0, latent).unwrap().contiguous().unwrap(),
        };
        let expected = Tensor::cat(&[&memory, &distributions], 1).unwrap();
        let what = format!("width {width}, encoded {encoded}, rows from {first}");
        assert_close(&now(&found), &expected, 1e-6, &what);
    }
    let rejected = Sequences { actions: &tensors[0], encoded: Some(&tensors[2]), noise };
    assert!(rssm(&rejected, &model(&tensors), &tensors[2], &tensors[3], Arithmetic::best()).is_err());
    if encoded == 0 {
        // The encoded samples are not used, and have no gradient.
        given.remove(1);
        let unused = Tensor::new(0f32, &Device::Cpu).unwrap();
        return assert_gradients(&given, |given| {
            steps(&[&given[..1], std::slice::from_ref(&unused), &given[1..]].concat())
        });
    }
    assert_gradients(&given, steps);
}

#[test]
fn the_divergence_of_two_posteriors_is_that_of_gaussians() {
    let of = |mean: [f32; 2], variance: [f32; 2]| {
        let row = |values: [f32; 2]| Tensor::new(&[values], &Device::Cpu).unwrap();
        Posterior::new(&row(mean), &row(variance.map(f32::ln))).unwrap()
    };
    let nats = |from: &Posterior, to: &Posterior| {
        from.balanced_divergence(to, 0.0, 0.0).unwrap().to_scalar::<f32>().unwrap()
    };
    let (wide, narrow) = (of([1.0, -2.0], [4.0, 1.0]), of([0.0, -2.0], [1.0, 0.25]));
    // Half of the sum of variance ratio, squared distance by variance, -1, and the logarithm of the variance ratio.
    let expected = |ratios: [f32; 2], distance: f32| {
        0.5 * (ratios.iter().map(|ratio| ratio - 1.0 - ratio.ln()).sum::<f32>() + distance)
    };
    assert!((nats(&wide, &narrow) - expected([4.0, 4.0], 1.0)).abs() < 1e-5);
    assert!((nats(&narrow, &wide) - expected([0.25, 0.25], 0.25)).abs() < 1e-5);
    assert_eq!(nats(&wide, &wide), 0.0);
    let row = |values: [f32; 4]| Tensor::new(&[values], &Device::Cpu).unwrap();
    let (from, to) = (row([1.0, -2.0, 4f32.ln(), 0.0]), row([0.0, -2.0, 0.0, 0.25f32.ln()]));
    let of_each = divergences(&from, Some(&to)).unwrap().to_vec2::<f32>().unwrap();
    let by_dimension = [expected([4.0, 1.0], 1.0), expected([1.0, 4.0], 0.0)];
    assert!(of_each[0].iter().zip(by_dimension).all(|(found, expected)| (found - expected).abs() < 1e-5));
    let normal = of([0.0, 0.0], [1.0, 1.0]);
    let mean = scalar(&wide.kl_divergence().unwrap()).unwrap() as f32;
    assert!((nats(&wide, &normal) - mean).abs() < 1e-5);
}

#[test]
fn gradients_of_the_balanced_divergence_are_finite_differences() {
    let mut random = random(12);
    let [posterior, prior] = [(); 2].map(|()| variable(&mut random, &[7, 6]));
    let free = 3.0;
    let nats = |row: usize| {
        let [posterior, prior] = [&posterior, &prior].map(|of| of.narrow(0, row, 1).unwrap());
        scalar(&balanced_divergence(&posterior, &prior, 0.0, 0.0).unwrap()).unwrap()
    };
    let above = (0..7).filter(|row| nats(*row) > free).count();
    assert!((2..6).contains(&above), "{above} rows diverge by more than {free} nats");
    assert_gradients(std::slice::from_ref(&prior), |prior| {
        balanced_divergence(posterior.as_tensor(), &prior[0], free, 0.0)
    });
    // The value is that of both parts, and the gradient that of the second.
    assert_gradients(std::slice::from_ref(&posterior), |posterior| {
        let (posterior, prior) = (&posterior[0], &prior.as_detached_tensor());
        balanced_divergence(posterior, prior, free, 1.0)?
            - balanced_divergence(&posterior.detach(), prior, free, 0.0)?
    });
    let both = balanced_divergence(posterior.as_tensor(), prior.as_tensor(), free, 0.1).unwrap();
    let one = balanced_divergence(posterior.as_tensor(), prior.as_tensor(), free, 0.0).unwrap();
    assert!((scalar(&both).unwrap() / scalar(&one).unwrap() - 1.1).abs() < 1e-6);
    let unknown = Tensor::full(f32::NAN, (7, 6), &Device::Cpu).unwrap();
    let lost = balanced_divergence(&unknown, prior.as_tensor(), free, 0.1).unwrap();
    assert!(scalar(&lost).unwrap().is_nan());
    let [of_both, of_one] = [both, one].map(|value| value.backward().unwrap());
    assert!(close(of_both.get(&prior).unwrap(), of_one.get(&prior).unwrap()));
}

#[test]
fn whole_sequences_give_the_states_of_single_steps() {
    MEMORIES.into_iter().for_each(assert_unrolled);
}

fn assert_unrolled(memory: Memory) {
    let (bench, architecture) = bench(memory);
    let (network, _) = built(&architecture);
    let times = [0, 1, 2].map(|time| [16, 40].map(|first| Sample::at(first + time)));
    let at = times.concat();
    let encoded = network.encode(&bench.data.observation(&at, &ANGLES).unwrap(), &mut Draw::Mean).unwrap();
    let (actions, start) = (bench.data.actions(&at).unwrap(), network.start(2, &Device::Cpu).unwrap());
    let whole = network.unroll(2, start.as_ref(), &encoded, &actions, &mut Draw::Mean).unwrap().state;
    for (row, first) in [(4, 16), (5, 40)] {
        let expected = stepped(&bench, &*network, first, first + 2);
        let row = |tensor: &Option<Tensor>| tensor.as_ref().unwrap().narrow(0, row, 1).unwrap();
        assert!(close(&row(&Some(whole.latent.clone())), &expected.latent), "{first}");
        assert!(close(&row(&whole.memory), expected.memory.as_ref().unwrap()), "{first}");
        let action = bench.data.actions(&[Sample::at(first + 2)]).unwrap();
        assert!(close(&row(&whole.action), &action), "{first}");
    }
}

#[test]
fn gradients_through_time_are_finite_differences() {
    MEMORIES.into_iter().for_each(assert_gradients_through_time);
}

fn assert_gradients_through_time(memory: Memory) {
    let (bench, architecture) = bench(memory);
    let (network, parameters) = built(&architecture);
    let window = Window { context: 6, horizon: 4, ..Window::TRANSITION };
    let training = settings();
    let objective = objective(&bench, network, &window, &training);
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
        assert!(agrees, "{memory}: {name}: {slope}");
    }
}

/// Two sequences of three samples, each of which predicts two.
fn assert_memory_agrees_with_its_twin(memory: Memory) {
    let twin = Twin::load(memory.name(), false, Arithmetic::best());
    let (network, parameters) = built(&twin.architecture);
    twin.set(&parameters);
    let seen = twin.values([(Modality::PROPRIOCEPTION, "input.vector")]);
    let encoded = network.encode(&seen, &mut Draw::Mean).unwrap();
    let start = network.start(2, &Device::Cpu).unwrap();
    let Seen { state, divergence, .. } =
        network.unroll(2, start.as_ref(), &encoded, twin.get("action"), &mut Draw::Mean).unwrap();
    let further = network.act(&state, twin.get("further_action")).unwrap();
    assert_close(state.memory.as_ref().unwrap(), twin.get("output.memory"), TWIN_TOLERANCE, "the memory");
    let mut total = (&divergence * twin.kl_weight).unwrap();
    let mut terms: BTreeMap<Modality, Vec<Tensor>> = BTreeMap::new();
    for (state, target, vector) in
        [(state, "target", "output.vector"), (further, "further_target", "output.further_vector")]
    {
        let decoded = network.decode(&state).unwrap();
        let vectors = [Modality::PROPRIOCEPTION, Modality::CONTACT_FORCE].map(|vector| &decoded[&vector]);
        let vectors = Tensor::cat(&vectors, 1).unwrap();
        assert_close(&vectors, twin.get(vector), TWIN_TOLERANCE, vector);
        let [angles, forces] = ["proprioception", "contact_force"].map(|name| format!("{target}.{name}"));
        let values = twin.values([(Modality::PROPRIOCEPTION, &*angles), (Modality::CONTACT_FORCE, &*forces)]);
        let targets =
            Targets { values: &values, losses: &BTreeMap::new(), parts: 1, score: Score::Loss, added: None };
        for term in network.losses(&state, targets).unwrap() {
            terms.entry(term.modality).or_default().push(term.value.get(0).unwrap());
        }
    }
    for (modality, values) in terms {
        let mean = Tensor::stack(&values, 0).unwrap().mean_all().unwrap();
        twin.assert_term(modality.name(), &mean);
        total = (total + (mean * twin.weights[&modality]).unwrap()).unwrap();
    }
    twin.assert_term("kl", &divergence);
    twin.assert_term("total", &total);
    twin.assert_gradients(&parameters, &total.backward().unwrap());
}

#[test]
fn reference_a_gated_recurrent_unit_agrees_with_pytorch_twin() {
    assert_memory_agrees_with_its_twin(Memory::Gru);
}

#[test]
fn reference_a_state_space_model_agrees_with_pytorch_twin() {
    let nats = Twin::load("rssm", false, Arithmetic::best()).get("output.nats").to_vec1::<f32>().unwrap();
    assert!(nats.iter().any(|nats| *nats > 1.0) && nats.iter().any(|nats| *nats < 1.0), "{nats:?}");
    assert_memory_agrees_with_its_twin(Memory::Rssm);
}

#[test]
fn rollouts_start_at_one_of_each_few_samples() {
    let mut random = random(3);
    let mut rows = |stride, batch| {
        Draw::Sample {
            random: &mut random,
            dropout: 0.0,
            missing: &mut Random::new(0, Stream::Missing { epoch: 0 }),
        }
        .one_of_each(stride, batch)
    };
    let mut found = [0; 11];
    for _ in 0..200 {
        let rows = rows(4, 11).unwrap();
        assert_eq!(rows.iter().map(|row| row / 4).collect::<Vec<_>>(), [0, 1, 2]);
        rows.iter().for_each(|row| found[*row as usize] += 1);
    }
    assert!(found.iter().all(|times| (25..100).contains(times)), "{found:?}");
    assert_eq!((rows(1, 11), rows(20, 3).unwrap().len()), (None, 1));
    assert_eq!(Draw::Mean.one_of_each(4, 11), Some(vec![2, 6, 9]));
    assert_eq!(Draw::Mean.one_of_each(1, 11), None);
}

#[test]
fn few_rollouts_have_the_loss_of_all_on_average() {
    let (bench, architecture) = bench(Memory::Gru);
    let window = Window { context: 6, horizon: 4, ..Window::TRANSITION };
    let at = [Sample::at(6), Sample::at(8), Sample::at(24)];
    let mean = |rollout_stride| {
        let (network, _) = built(&architecture);
        let training = Training { rollout_stride, ..settings() };
        let objective = objective(&bench, network, &window, &training);
        assert_eq!(objective.predicted(), if rollout_stride == 1 { 24 } else { 6 + 5 });
        let mut random = random(5);
        let mut loss = || {
            let draw = Draw::Sample {
                random: &mut random,
                dropout: 0.0,
                missing: &mut Random::new(0, Stream::Missing { epoch: 0 }),
            };
            scalar(&objective.terms(&at, draw).unwrap()[0].value).unwrap()
        };
        (0..100).map(|_| loss()).sum::<f64>() / 100.0
    };
    let (all, few) = (mean(1), mean(4));
    assert!((few / all - 1.0).abs() < 0.03, "{few} of some rollouts, {all} of all");
}

#[test]
fn further_predictions_weigh_less_by_the_discount() {
    let (bench, architecture) = bench(Memory::Gru);
    let at = [Sample::at(6), Sample::at(24)];
    let loss = |horizon, discount| {
        let (network, _) = built(&architecture);
        let (window, training) = (Window { context: 6, horizon, ..Window::TRANSITION }, settings());
        let training = Training { discount, ..training };
        let terms = objective(&bench, network, &window, &training).terms(&at, Draw::Mean).unwrap();
        terms[0].value.to_scalar::<f32>().unwrap()
    };
    // The losses at single distances follow from their means over 1, 2 and 3 of them.
    let means = [1, 2, 3].map(|horizon| loss(horizon, 1.0));
    let [first, second, third] = [means[0], 2.0 * means[1] - means[0], 3.0 * means[2] - 2.0 * means[1]];
    for discount in [0.7, 0.1_f32] {
        let expected = (first + discount * second + discount * discount * third)
            / (1.0 + discount + discount * discount);
        let found = loss(3, f64::from(discount));
        assert!((found - expected).abs() < 1e-5, "{discount}: {found}, {expected}");
        assert!((found - means[2]).abs() > 1e-3, "{discount} makes no difference");
    }
    // Without a discount, the loss is the plain mean to the last bit, and one distance has all the weight.
    assert_eq!(loss(3, 1.0), plain_mean(&bench, &architecture, &at, 6, 3));
    assert_eq!(loss(1, 0.7), first);
}

/// The terms of a loss over two sequences of six samples, each of which predicts three, and the gradients of the sum.
fn terms_and_gradients(
    bench: &Bench,
    architecture: &Architecture,
    training: &Training,
) -> (Vec<f32>, BTreeMap<String, Vec<f32>>) {
    let (network, parameters) = built(architecture);
    let window = Window { context: 6, horizon: 3, ..Window::TRANSITION };
    let objective = objective(bench, network, &window, training);
    let terms = objective.terms(&[Sample::at(6), Sample::at(24)], Draw::Mean).unwrap();
    let values: Vec<Tensor> = terms.into_iter().map(|term| term.value).collect();
    gradients_of(&values, &parameters)
}

/// The values of scalars, and the gradients of their sum.
fn gradients_of(values: &[Tensor], parameters: &Parameters) -> (Vec<f32>, BTreeMap<String, Vec<f32>>) {
    let total = Tensor::stack(values, 0).unwrap().sum_all().unwrap();
    let gradients = total.backward().unwrap();
    let gradient = |var: &Var| gradients.get(var).unwrap().flatten_all().unwrap().to_vec1().unwrap();
    let gradients = parameters.iter().map(|(name, var)| (name.clone(), gradient(var))).collect();
    (values.iter().map(|value| value.to_scalar().unwrap()).collect(), gradients)
}

/// The largest difference between two lists of numbers.
fn difference<'a>(one: impl IntoIterator<Item = &'a f32>, other: impl IntoIterator<Item = &'a f32>) -> f32 {
    one.into_iter().zip(other).map(|(one, other)| (one - other).abs()).fold(0.0, f32::max)
}

#[test]
fn truncated_gradients_change_no_value() {
    for memory in MEMORIES {
        let (bench, architecture) = bench(memory);
        let of = |truncate| {
            let training = Training { truncate, ..settings() };
            terms_and_gradients(&bench, &architecture, &training)
        };
        let whole = of(None);
        assert_eq!(of(Some(6)), whole, "{memory}: to the last bit");
        for truncate in [1, 4, 5] {
            let (values, gradients) = of(Some(truncate));
            assert!(difference(&values, &whole.0) < 1e-6, "{memory} {truncate}: {values:?} {:?}", whole.0);
            let difference = difference(gradients.values().flatten(), whole.1.values().flatten());
            assert!(difference > 1e-5, "{memory} {truncate}: the gradients differ by {difference}");
        }
    }
}

#[test]
fn a_burn_in_has_no_loss_and_no_gradient() {
    for memory in MEMORIES {
        let (bench, architecture) = bench(memory);
        let training = Training { burn_in: 4, ..settings() };
        let (values, gradients) = terms_and_gradients(&bench, &architecture, &training);
        // Two more samples are seen after a constant state, which is that of single steps.
        let (network, parameters) = built(&architecture);
        let data = &bench.data;
        let constant = [(1, 4), (19, 22)].map(|(first, last)| {
            let state = stepped(&bench, &*network, first, last);
            network.act(&state, &data.actions(&[Sample::at(last)]).unwrap()).unwrap()
        });
        let both = |of: fn(&State) -> &Tensor| Tensor::cat(&constant.each_ref().map(of), 0).unwrap().detach();
        let start = State {
            latent: both(|state| &state.latent),
            action: Some(both(|state| state.action.as_ref().unwrap())),
            memory: Some(both(|state| state.memory.as_ref().unwrap())),
        };
        let seen = [5, 23, 6, 24].map(Sample::at);
        let [loss, divergence] = losses_after(&bench, &*network, Some(&start), &seen, 2, 3);
        let expected = gradients_of(&[loss, divergence], &parameters);
        assert!(difference(&values, &expected.0) < 1e-6, "{memory}: {values:?} {:?}", expected.0);
        let difference = difference(gradients.values().flatten(), expected.1.values().flatten());
        assert!(difference < 1e-5, "{memory}: {difference}");
        // A step takes more windows, because each has fewer predictions: two samples that predict three.
        let window = Window { context: 6, horizon: 3, ..Window::TRANSITION };
        assert_eq!(objective(&bench, network, &window, &training).predicted(), 2 * 3);
    }
}

/// The mean loss of the samples after those that are seen, `batch` at each time, and the divergence.
fn losses_after(
    bench: &Bench,
    network: &dyn Predicting,
    start: Option<&State>,
    seen: &[Sample],
    batch: usize,
    horizon: usize,
) -> [Tensor; 2] {
    let data = &bench.data;
    let encoded = network.encode(&data.observation(seen, &ANGLES).unwrap(), &mut Draw::Mean).unwrap();
    let actions = data.actions(seen).unwrap();
    let Seen { mut state, divergence, .. } =
        network.unroll(batch, start, &encoded, &actions, &mut Draw::Mean).unwrap();
    let ahead = |distance| seen.iter().map(|sample| sample.after(distance)).collect::<Vec<_>>();
    let losses = (1..=horizon).map(|distance| {
        if distance > 1 {
            state = network.act(&state, &data.actions(&ahead(distance - 1)).unwrap()).unwrap();
        }
        let values = data.observation(&ahead(distance), &ARM).unwrap();
        let targets =
            Targets { values: &values, losses: &BTreeMap::new(), parts: 1, score: Score::Loss, added: None };
        network.losses(&state, targets).unwrap().remove(0).value.get(0).unwrap()
    });
    let losses: Vec<Tensor> = losses.collect();
    [Tensor::stack(&losses, 0).unwrap().mean_all().unwrap(), divergence]
}

/// The mean loss of all distances up to the horizon, of the network that `built` makes.
fn plain_mean(
    bench: &Bench,
    architecture: &Architecture,
    at: &[Sample],
    context: usize,
    horizon: usize,
) -> f32 {
    let (network, _) = built(architecture);
    let seen: Vec<Sample> =
        (0..context).rev().flat_map(|distance| at.iter().map(move |last| last.before(distance))).collect();
    let start = network.start(at.len(), &Device::Cpu).unwrap();
    let [loss, _] = losses_after(bench, &*network, start.as_ref(), &seen, at.len(), horizon);
    loss.to_scalar().unwrap()
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
    MEMORIES.into_iter().for_each(assert_states);
}

fn assert_states(memory: Memory) {
    let (bench, architecture) = bench(memory);
    let (network, _) = built(&architecture);
    let data = &bench.data;
    for (start, context) in [(WindowStart::Random, 5), (WindowStart::Rest, 5), (WindowStart::Random, 1)] {
        // The second episode has the samples 16 to 31. Its first samples have a shorter context.
        let first = |present: usize| match start {
            WindowStart::Rest => 16,
            WindowStart::Random => (present + 1 - context).max(16),
        };
        let window = Window { context, start, horizon: 3, ..Window::TRANSITION };
        let latents = Latents::of(&*network, data, &ANGLES, &window).unwrap();
        for present in [17, 20, 31] {
            let expected = stepped(&bench, &*network, first(present), present).latent;
            let found = latents.rows(&[Sample::at(present)]).unwrap();
            assert!(close(&found, &expected), "{start} {context} {present}");
        }
        // A prediction of three samples is three single steps, whatever other windows are predicted with it.
        let trained = TrainedNetwork {
            data,
            network: network.detached(),
            input: &ANGLES,
            output: &ARM,
            window: &window,
            draws: 0,
            seed: 0,
        };
        let predicted = |at: &[Sample]| {
            let mut found = Vec::new();
            let mut keep = |predicted: &harness_judge::Predicted| {
                found.push(predicted.values[predicted.values.len() - ARM_JOINTS..].to_vec());
                Ok(())
            };
            trained.predict(at, &mut keep).unwrap();
            found
        };
        let mut state = stepped(&bench, &*network, first(24), 24);
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

/// A state that has ended is not rolled on past the last sample of the dataset.
#[test]
fn the_last_episode_may_be_shorter() {
    for (memory, start) in
        MEMORIES.into_iter().flat_map(|memory| [(memory, WindowStart::Rest), (memory, WindowStart::Random)])
    {
        let (mut bench, architecture) = bench(memory);
        bench.data.samples = Arc::new(walks_of(&[16, 16, 5]));
        let (network, _) = built(&architecture);
        let window = Window { context: 12, start, ..Window::TRANSITION };
        let latents = Latents::of(&*network, &bench.data, &ANGLES, &window).unwrap();
        let expected = stepped(&bench, &*network, 32, 36).latent;
        assert!(close(&latents.rows(&[Sample::at(36)]).unwrap(), &expected), "{memory} {start}");
    }
}

/// Trains a network with or without memory, and returns its R2 of the arm at 1 and at 3 samples ahead, and that of
/// persistence.
fn r2_of_arm(memory: Memory) -> [[f64; 2]; 2] {
    let (bench, architecture) = bench(memory);
    let (network, parameters) = built(&architecture);
    let horizon = if memory == Memory::None { 1 } else { 3 };
    let window = Window { context: 12, start: WindowStart::Rest, horizon, ..Window::TRANSITION };
    let training =
        Training { epochs: 150, learning_rate: 5e-3, patience: None, batch_size: 128, ..Training::default() };
    let objective = objective(&bench, network, &window, &training);
    let partition = &bench.data.samples.partition(&Split::default(), &window).unwrap();
    let (state, progress) = (&StateFile::none(), &harness_shared::progress::Silent);
    let task = Task::Prediction;
    let fit = Fit { task, training: &training, seed: 0, partition, state, progress, log: &|_| () };
    fit.run(&objective, &parameters).unwrap();
    let (data, samples) = (&bench.data, &*bench.data.samples);
    let network = objective.network.detached();
    let trained =
        TrainedNetwork { data, network, input: &ANGLES, output: &ARM, window: &window, draws: 0, seed: 0 };
    let horizons = window.horizons();
    let persistence = Persistence { samples, modality: Modality::ARM, horizons: &horizons };
    let models: [&dyn Predictor; 2] = [&trained, &persistence];
    models.map(|model| {
        let judged =
            judge(model, &Test { samples, task, windows: &partition.test, since_s: &[], sampled: Some(&[]) })
                .unwrap();
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
    let [without, _] = r2_of_arm(Memory::None);
    for memory in MEMORIES {
        let [with, _] = r2_of_arm(memory);
        println!("R2 of the arm: with {memory} {with:?}, without {without:?}");
        assert!(with.iter().all(|with| *with > without[0] + 0.2), "{memory} {with:?}, without {without:?}");
    }
}
