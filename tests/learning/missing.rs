//! Inputs that a network does not get, in training or in a test.

use super::changes::{BOTH, MEMORIES, WINDOW, bench, predicting, trained};
use super::*;
use harness_judge::Predictor;
use harness_spec::{ModalityDropout, Together};

#[test]
fn a_missing_input_is_at_its_mean() {
    let data = Bench::new().data;
    let at = at(0..5);
    let values =
        |data: &NormalizedData, modality| match data.inputs(&at, &INPUT).unwrap().get(modality).unwrap() {
            Value::Vector(vector) => vector.flatten_all().unwrap().to_vec1::<f32>().unwrap(),
            Value::Frames(frames) => {
                frames.tensor(&Device::Cpu).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap()
            }
        };
    for (kept, missing) in [(INPUT[0], INPUT[1]), (INPUT[1], INPUT[0])] {
        let some = data.giving(vec![kept], "");
        assert_eq!(values(&some, kept), values(&data, kept));
        assert!(values(&some, missing).iter().all(|value| *value == 0.0));
        assert!(values(&data, missing).iter().any(|value| *value != 0.0));
    }
    // A predicted change is added to what the network got.
    let some = data.giving(vec![Modality::VISION], "");
    let mean = &data.normalizers.modalities[&Modality::PROPRIOCEPTION].mean;
    assert_eq!(some.given_values(Modality::PROPRIOCEPTION, &at), mean.repeat(at.len()));
    assert_eq!(some.given_values(Modality::VISION, &at), data.given_values(Modality::VISION, &at));
}

#[test]
fn windows_lack_inputs_at_their_rates_but_never_all_of_them() {
    let rates = ModalityDropout::Of([(Modality::ARM, 0.9), (Modality::VISION, 0.9)].into());
    let inputs = [Modality::ARM, Modality::VISION, Modality::PROPRIOCEPTION];
    let mut missing = Random::new(7, Stream::Missing { epoch: 0 });
    let draw = |missing: &mut Random, number: usize| {
        let mut draw = Draw::Sample { random: &mut random(0), dropout: 0.0, missing };
        draw.keeping(&rates, &inputs[..number], 20_000)
    };
    let share = |kept: &[f32]| f64::from(kept.iter().sum::<f32>()) / kept.len() as f64;
    // Of three inputs, the third one is always there.
    let of_three = draw(&mut missing, 3);
    assert!(of_three.values().all(|kept| (share(kept) - 0.1).abs() < 0.01));
    // Of two, both lack with 0.81, which is drawn again.
    let of_two = draw(&mut missing, 2);
    assert!(of_two.values().all(|kept| (share(kept) - 0.1 / 0.19).abs() < 0.02));
    let [arm, vision] = [Modality::ARM, Modality::VISION].map(|modality| &of_two[&modality]);
    assert!(arm.iter().zip(vision).all(|(arm, vision)| arm + vision > 0.0));
    assert!(Draw::Mean.keeping(&rates, &inputs, 5).is_empty());
    assert_eq!(draw(&mut Random::new(7, Stream::Missing { epoch: 0 }), 3), of_three);
}

#[test]
fn a_window_lacks_the_inputs_of_one_item_together() {
    let item = |inputs: &[Modality], probability| Together { inputs: inputs.to_vec(), probability };
    let touch = [Modality::CONTACT_FORCE, Modality::CONTACT_FORCE_MEAN];
    let items = [item(&touch, 0.3), item(&[Modality::ARM], 0.2), item(&[Modality::ARM, touch[0]], 0.4)];
    let dropout = ModalityDropout::Together(items.to_vec());
    let input = [touch[0], touch[1], Modality::ARM, Modality::PROPRIOCEPTION];
    let mut missing = Random::new(7, Stream::Missing { epoch: 0 });
    let mut draw = Draw::Sample { random: &mut random(0), dropout: 0.0, missing: &mut missing };
    let windows = 20_000;
    let kept = draw.keeping(&dropout, &input, windows);
    assert!(!kept.contains_key(&Modality::PROPRIOCEPTION));
    let share = |of: [f32; 3]| {
        let is_so = |window: &usize| {
            [touch[0], touch[1], Modality::ARM].map(|modality| kept[&modality][*window]) == of
        };
        (0..windows).filter(is_so).count() as f64 / windows as f64
    };
    for (of, expected) in
        [([0.0, 0.0, 1.0], 0.3), ([1.0, 1.0, 0.0], 0.2), ([0.0, 1.0, 0.0], 0.4), ([1.0; 3], 0.1)]
    {
        assert!((share(of) - expected).abs() < 0.015, "{of:?}: {}", share(of));
    }
}

/// The terms of the loss, when all windows lack an input in training, and when the network gets only the other one. The
/// change of the arm is predicted, which is then that from the arm's mean.
#[test]
fn a_window_that_lacks_an_input_has_the_loss_of_one_that_is_not_given() {
    for (memory, lacking) in MEMORIES.into_iter().flat_map(|memory| [(memory, 0), (memory, 1)]) {
        let (bench, network, _) = bench(memory, Family::None);
        let other = bench.data.giving(vec![BOTH[1 - lacking]], "other");
        let losses = |data: &NormalizedData, rate: f64| {
            let modality_dropout = ModalityDropout::Of([(BOTH[lacking], rate)].into());
            let training = Training { modality_dropout, rollout_stride: 3, ..bench.training.clone() };
            let network = network.detached();
            let window = WINDOW;
            let objective = predicting(data, network, &window, &training);
            let (mut random, mut missing) = (random(3), Random::new(1, Stream::Missing { epoch: 0 }));
            let draw = Draw::Sample { random: &mut random, dropout: 0.0, missing: &mut missing };
            let terms = objective.terms(&bench.partition.test[..6], draw).unwrap();
            terms.iter().map(|term| term.value.to_scalar::<f32>().unwrap().to_bits()).collect::<Vec<_>>()
        };
        assert_eq!(losses(&bench.data, 1.0), losses(&other, 0.0), "{memory}");
        assert_ne!(losses(&bench.data, 1.0), losses(&bench.data, 0.0), "{memory}");
        let window = WINDOW;
        assert_eq!(trained(&other, network, &window).given(), Some("other"));
    }
}

/// The numbers of a matrix, row by row.
fn numbers(tensor: candle_core::Result<Tensor>) -> Vec<f32> {
    tensor.unwrap().flatten_all().unwrap().to_vec1().unwrap()
}

#[test]
fn a_product_of_one_expert_is_that_expert_and_precisions_of_several_are_added() {
    let gaussian = |seed| {
        let values = normal(&mut random(seed), &[4, 6]);
        Posterior::new(&values.narrow(1, 0, 3).unwrap(), &values.narrow(1, 3, 3).unwrap()).unwrap()
    };
    let column = |kept: [f32; 4]| Tensor::from_vec(kept.to_vec(), (4, 1), &Device::Cpu).unwrap();
    let product = |experts: Vec<(u64, [f32; 4])>| {
        let experts = experts.into_iter();
        let experts =
            experts.map(|(seed, kept)| Expert { posterior: gaussian(seed), kept: Some(column(kept)) });
        Posterior::product(&experts.collect::<Vec<_>>()).unwrap()
    };
    let close = |one: &Posterior, other: &Posterior, rows: &[usize]| {
        for (one, other) in [(one.mean(), other.mean()), (one.log_variance(), other.log_variance())]
            .map(|(a, b)| (numbers(a), numbers(b)))
        {
            assert!(
                rows.iter().all(|row| (3 * row..3 * row + 3).all(|at| (one[at] - other[at]).abs() < 1e-6))
            );
        }
    };
    close(&product(vec![(1, [1.0; 4])]), &gaussian(1), &[0, 1, 2, 3]);
    let both = product(vec![(1, [1.0; 4]), (2, [1.0, 0.0, 1.0, 0.0])]);
    close(&both, &gaussian(1), &[1, 3]);
    let [one, other] =
        [1, 2].map(|seed| (numbers(gaussian(seed).mean()), numbers(gaussian(seed).log_variance())));
    for at in (0..3).chain(6..9) {
        let (a, b) = ((-one.1[at]).exp(), (-other.1[at]).exp());
        assert!((numbers(both.log_variance())[at] + (a + b).ln()).abs() < 1e-6);
        assert!((numbers(both.mean())[at] - (a * one.0[at] + b * other.0[at]) / (a + b)).abs() < 1e-6);
    }
    assert!(Posterior::product(&[]).is_err());
    // A value far from all others makes no precision infinite.
    let far = Tensor::full(-1000.0_f32, (1, 3), &Device::Cpu).unwrap();
    let far = Expert { posterior: Posterior::new(&far, &far).unwrap(), kept: None };
    let product = Posterior::product(&[far]).unwrap();
    assert_eq!(
        (numbers(product.mean()), numbers(product.log_variance())),
        (vec![-1000.0; 3], vec![-20.0; 3])
    );
}

/// With the prior, which is a standard normal distribution, the precision given both inputs is the sum of those given
/// each, minus 1.
#[test]
fn a_product_leaves_out_the_input_that_is_not_given() {
    let bench = Bench::new();
    let network = Network { fusion: Fusion::Product, ..bench.architecture().network };
    let architecture = Architecture { network, ..bench.architecture() };
    let encoder = architecture.encoder(&mut Parameters::new(), &mut random(0), &Device::Cpu).unwrap();
    let at = at(0..5);
    let posterior = |data: &NormalizedData| {
        let posterior = encoder.encode(&data.inputs(&at, &INPUT).unwrap()).unwrap();
        let precision: Vec<f32> =
            numbers(posterior.log_variance()).into_iter().map(|log| (-log).exp()).collect();
        (numbers(posterior.mean()), precision)
    };
    let both = posterior(&bench.data);
    let [one, other] = [0, 1].map(|index| posterior(&bench.data.giving(vec![INPUT[index]], "")));
    for (index, precision) in both.1.iter().enumerate() {
        let (a, b) = (one.1[index], other.1[index]);
        assert!(a > 1.0 && b > 1.0 && (precision - (a + b - 1.0)).abs() < 1e-4, "{precision}, {a}, {b}");
        let mean = (a * one.0[index] + b * other.0[index]) / precision;
        assert!((both.0[index] - mean).abs() < 1e-5);
    }
    // Some windows lack an input.
    let kept = [(INPUT[1], vec![1.0, 0.0, 1.0, 0.0, 0.0])].into();
    let some = encoder.encode(&bench.data.inputs(&at, &INPUT).unwrap().keeping(&kept).unwrap()).unwrap();
    let (mean, latent) = (numbers(some.mean()), some.latent().unwrap());
    for row in 0..5 {
        let expected = if [0, 2].contains(&row) { &both.0 } else { &one.0 };
        let columns = row * latent..(row + 1) * latent;
        assert!(
            mean[columns.clone()].iter().zip(&expected[columns]).all(|(a, b)| (a - b).abs() < 1e-6),
            "{row}"
        );
    }
}
