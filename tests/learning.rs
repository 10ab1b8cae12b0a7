//! Own ops compared with finite differences and candle's operations, the network compared with the same network in
//! PyTorch, and training: deterministic, resumable, stopped early.

use candle_core::backprop::GradStore;
use candle_core::{Device, Result, Tensor, Var};
use candle_nn::{AdamW, Optimizer, ParamsAdamW};
use finger::{ARM_JOINTS, JOINTS};
use harness_kernels::convolution::LANES;
use harness_kernels::product::{Arithmetic, Unit};
use harness_learning::data::NormalizedData;
use harness_learning::network::description::Description;
use harness_learning::network::{
    Architecture, Draw, Encoder, Expert, Observation, Parameters, Posterior, Score, Targets, Value,
};
use harness_learning::objective::{Objective, Prediction, Weighted};
use harness_learning::random::{Random, Stream};
use harness_learning::state::StateFile;
use harness_learning::tensors::TensorFile;
use harness_learning::training::{Epoch, Fit, TOTAL, learning_rate};
use harness_learning::{LearningError, checkpoint};
use harness_ops::frames::{Averaged, DenseFrames, Frames};
use harness_ops::{
    Adam, Dropout, FrameDecoder, Quantity, Stack, TwoLayers, composed, frame_decoder, frame_encoder,
    frame_loss, kl_divergence, linear, sample, two_layers, vector_losses,
};
use harness_samples::{Normalizer, Normalizers, Partition, Sample};
use harness_shared::progress::Progress;
use harness_spec::{
    Action, Family, Fusion, Layout, Loss, Memory, Modality, Network, Preset, Scenario, Schedule, Split, Stop,
    Task, Training, Window, World,
};
use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;
use walks::{walks, walks_of};

#[path = "learning/additions.rs"]
mod additions;
#[path = "learning/categories.rs"]
mod categories;
#[path = "learning/changes.rs"]
mod changes;
#[path = "learning/disturbed.rs"]
mod disturbed;
#[path = "common/finger.rs"]
mod finger;
#[path = "learning/heads.rs"]
mod heads;
#[path = "learning/memory.rs"]
mod memory;
#[path = "learning/missing.rs"]
mod missing;
#[path = "learning/sets.rs"]
mod sets;
#[path = "common/walks.rs"]
mod walks;

/// Path of the repository.
const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");

fn random(seed: u64) -> Random {
    Random::new(seed, Stream::Parameters(Task::Prediction))
}

fn normal(random: &mut Random, shape: &[usize]) -> Tensor {
    Tensor::from_vec(random.normal(shape.iter().product()), shape, &Device::Cpu).unwrap()
}

fn variable(random: &mut Random, shape: &[usize]) -> Var {
    Var::from_tensor(&normal(random, shape)).unwrap()
}

fn scalar(tensor: &Tensor) -> Result<f64> {
    tensor.to_scalar::<f32>().map(f64::from)
}

fn dense(frames: &Tensor) -> Arc<dyn Frames> {
    Arc::new(DenseFrames::new(frames).unwrap())
}

fn dot(a: &Tensor, b: &Tensor) -> f64 {
    let values = |tensor: &Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    values(a).iter().zip(values(b)).map(|(a, b)| f64::from(*a) * f64::from(b)).sum()
}

/// Compares the gradient of each argument in a random direction with the central difference of `function`.
fn assert_gradients(arguments: &[Var], function: impl Fn(&[Tensor]) -> Result<Tensor>) {
    // With a large step, a ReLU may switch between the two sides. With a small step, rounding is large. One step must
    // agree.
    const STEPS: [f64; 3] = [2e-4, 5e-4, 1e-3];
    let mut random = random(99);
    let tensors: Vec<Tensor> = arguments.iter().map(|var| var.as_tensor().clone()).collect();
    let output = function(&tensors).unwrap();
    // The randomly weighted sum of the outputs is a scalar that depends on all of them.
    let weights = normal(&mut random, output.dims());
    let gradients = (&output * &weights).unwrap().sum_all().unwrap().backward().unwrap();
    for (index, argument) in arguments.iter().enumerate() {
        let direction = normal(&mut random, argument.dims());
        let at = |step: f64| {
            let mut moved: Vec<Tensor> = tensors.iter().map(Tensor::detach).collect();
            moved[index] = (&moved[index] + (&direction * step).unwrap()).unwrap();
            dot(&function(&moved).unwrap(), &weights)
        };
        let differences = STEPS.map(|step| (at(step) - at(-step)) / (2.0 * step));
        let found = dot(gradients.get(argument).expect("a gradient"), &direction);
        let agrees = |expected: &f64| (found - expected).abs() < 2e-2 * expected.abs().max(0.1);
        assert!(differences.iter().any(agrees), "argument {index}: {found} instead of {differences:?}");
    }
}

fn assert_close(found: &Tensor, expected: &Tensor, tolerance: f64, what: &str) {
    assert_eq!(found.dims(), expected.dims(), "shape of {what}");
    let largest = |tensor: &Tensor| {
        let values = tensor.abs().unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        values.into_iter().map(f64::from).fold(0.0, f64::max)
    };
    let error = largest(&(found - expected).unwrap());
    let scale = largest(expected).max(1e-6);
    assert!(error <= tolerance * scale, "{what} is off by {error}, of {scale}");
}

#[test]
fn gradients_of_linear_are_those_of_finite_differences() {
    let mut random = random(1);
    let arguments =
        [variable(&mut random, &[5, 7]), variable(&mut random, &[4, 7]), variable(&mut random, &[4])];
    for relu in [false, true] {
        assert_gradients(&arguments, |args| linear(&args[0], &args[1], &args[2], relu, Arithmetic::best()));
    }
}

/// Two convolutions, and a number of images that fills one group of lanes and a part of another.
fn stack() -> (Stack, usize) {
    (Stack::new(2, [8, 4], &[3, 5]), LANES + 3)
}

#[test]
fn frame_encoder_gradients_are_those_of_finite_differences() {
    let mut random = random(2);
    let (stack, images) = stack();
    let frames = dense(&normal(&mut random, &[images, 2, 8, 4]));
    let parameters = stack.layers().iter().map(|sizes| sizes.kernel_len() + sizes.coarse_channels).sum();
    let arguments = [variable(&mut random, &[parameters]), variable(&mut random, &[4, stack.coarse_len()])];
    for dropout in [None, Some(Dropout::new(0.3, 7))] {
        assert_gradients(&arguments, |args| {
            frame_encoder(frames.clone(), &stack, &args[0], &args[1], Arithmetic::best(), dropout)
        });
    }
}

#[test]
fn gradients_of_two_layers_are_those_of_finite_differences() {
    let mut random = random(11);
    // Eleven rows are split into parts of unequal size.
    let shapes: [&[usize]; 5] = [&[11, 7], &[6, 7], &[6], &[4, 6], &[4]];
    let arguments = shapes.map(|shape| variable(&mut random, shape));
    assert_gradients(&arguments, |args| {
        let [x, hidden_weight, hidden_bias, weight, bias] = [0, 1, 2, 3, 4].map(|index| &args[index]);
        two_layers(x, TwoLayers { hidden_weight, hidden_bias, weight, bias }, Arithmetic::best())
    });
}

#[test]
fn gradients_of_the_frame_loss_are_those_of_finite_differences() {
    let mut random = random(3);
    let (stack, images) = stack();
    let target = dense(&normal(&mut random, &[images, 2, 8, 4]));
    let parameters: usize = stack.layers().iter().map(|sizes| sizes.kernel_len() + sizes.fine_channels).sum();
    let arguments = [
        variable(&mut random, &[images, 4]),
        variable(&mut random, &[stack.coarse_len(), 4]),
        variable(&mut random, &[parameters + stack.coarse_len()]),
    ];
    assert_gradients(&arguments, |args| {
        let [hidden, weight, packed] = [0, 1, 2].map(|index| args[index].clone());
        let decoder = FrameDecoder { stack: stack.clone(), weight, packed, arithmetic: Arithmetic::best() };
        // A weighted term has an upstream gradient other than one.
        frame_loss(&hidden, decoder, target.clone())? * 3.0
    });
}

#[test]
fn posterior_and_vector_loss_gradients_are_finite_differences() {
    let mut random = random(31);
    let (noise, target) = (normal(&mut random, &[4, 3]), normal(&mut random, &[4, 5]));
    assert_gradients(&[variable(&mut random, &[4, 6])], |args| sample(&args[0], &noise));
    assert_gradients(&[variable(&mut random, &[4, 6])], |args| kl_divergence(&args[0])? * 2.0);
    for loss in Loss::ALL {
        let quantities = [Quantity { width: 2, loss: *loss }, Quantity { width: 3, loss: Loss::Squared }];
        let predicted = variable(&mut random, &[4, 5]);
        assert_gradients(&[predicted], |args| vector_losses(&args[0], &target, &quantities, 2));
    }
}

#[test]
fn vector_losses_are_those_of_definitions_and_candle_operations() {
    // Calculated by hand for errors of 0.5, -2 and 3.
    let expected = |loss: Loss| match loss {
        Loss::Squared => (0.25 + 4.0 + 9.0) / 3.0,
        Loss::Absolute => (0.5 + 2.0 + 3.0) / 3.0,
        Loss::Huber => (0.25 + (2.0 * 2.0 - 1.0) + (2.0 * 3.0 - 1.0)) / 3.0,
    };
    let errors = Var::new(&[[0.5f32, -2.0, 3.0]], &Device::Cpu).unwrap();
    let target = Tensor::new(&[[1.0f32, 2.0, -3.0]], &Device::Cpu).unwrap();
    for loss in Loss::ALL {
        let predicted = (errors.as_tensor() + &target).unwrap();
        let own = vector_losses(&predicted, &target, &[Quantity { width: 3, loss: *loss }], 1).unwrap();
        let theirs = composed(*loss, &errors).unwrap().mean_all().unwrap();
        let gradient = |loss: &Tensor| loss.backward().unwrap().get(&errors).unwrap().clone();
        assert_close(&gradient(&own), &gradient(&theirs), 1e-6, &format!("the gradient of {loss}"));
        let values =
            [own.flatten_all().unwrap().get(0), Ok(theirs)].map(|value| scalar(&value.unwrap()).unwrap());
        assert!(values.iter().all(|value| (value - expected(*loss)).abs() < 1e-6), "{loss}: {values:?}");
    }
}

#[test]
fn gradients_reach_what_weights_are_computed_from() {
    let mut random = random(32);
    let x = normal(&mut random, &[2, 3]);
    assert_gradients(&[variable(&mut random, &[4, 3]), variable(&mut random, &[4])], |args| {
        linear(&x, &(&args[0] * 2.0)?, &args[1], false, Arithmetic::best())
    });
}

#[test]
fn dropout_leaves_out_its_share_and_keeps_the_mean() {
    let kept = |share: f64, seed: u64, sample: usize| {
        let mut values = vec![1.0f32; 100_001];
        Dropout::new(share, seed).apply(sample, &mut values);
        values
    };
    for share in [0.1, 0.5, 0.9] {
        let values = kept(share, 3, 0);
        let left_out = values.iter().filter(|value| **value == 0.0).count() as f64 / values.len() as f64;
        assert!((left_out - share).abs() < 0.005, "{left_out} of the values, not {share}");
        let mean = values.iter().map(|value| f64::from(*value)).sum::<f64>() / values.len() as f64;
        assert!((mean - 1.0).abs() < 0.03, "{share}: a mean of {mean}");
    }
    let values = kept(0.5, 3, 0);
    assert!(values == kept(0.5, 3, 0), "the same again");
    assert!(values != kept(0.5, 4, 0), "another seed");
    assert!(values != kept(0.5, 3, 1), "another sample");
}

#[test]
fn dropout_is_for_training_alone_and_goes_by_the_seed() {
    let mut bench = Bench::new();
    let (without, _) = bench.train_undisturbed(7);
    bench.training.dropout = 0.5;
    let (with, parameters) = bench.train_undisturbed(7);
    assert_ne!(losses(&without), losses(&with));
    let (again, same) = bench.train_undisturbed(7);
    assert!(losses(&with) == losses(&again) && bits(&parameters) == bits(&same));
    // Both start with the same weights, so the losses of the first epoch differ only because values were dropped.
    assert_ne!(without[0].train[TOTAL].to_bits(), with[0].train[TOTAL].to_bits());
}

#[test]
fn own_ops_agree_with_candles_operations() {
    for size in [[16, 16], [16, 24], [32, 12]] {
        agree_with_candles_operations(size);
    }
}

fn agree_with_candles_operations([rows, columns]: [usize; 2]) {
    let mut random = random(5);
    let (stack, batch) = (Stack::new(3, [rows, columns], &[4, 6]), LANES + 3);
    let coarse = rows / 4 * (columns / 4);
    let frames = normal(&mut random, &[batch, 3, rows, columns]);
    let kernels = [normal(&mut random, &[4, 3, 4, 4]), normal(&mut random, &[6, 4, 4, 4])];
    let flat = |tensors: &[&Tensor]| {
        let flat = tensors.iter().map(|tensor| tensor.flatten_all().unwrap()).collect::<Vec<_>>();
        Tensor::cat(&flat, 0).unwrap()
    };
    let channelwise = |image: &Tensor, bias: &Tensor| {
        image.broadcast_add(&bias.reshape((1, bias.elem_count(), 1, 1)).unwrap()).unwrap()
    };

    let (biases, weight) =
        ([4, 6].map(|len| normal(&mut random, &[len])), normal(&mut random, &[5, 6 * coarse]));
    let packed = flat(&[&kernels[0], &biases[0], &kernels[1], &biases[1]]);
    let mut active = frames.clone();
    for (kernel, bias) in kernels.iter().zip(&biases) {
        active = channelwise(&active.conv2d(kernel, 1, 2, 1, 1).unwrap(), bias).relu().unwrap();
    }
    let active = active.flatten_from(1).unwrap();
    let found = |dropout| {
        frame_encoder(dense(&frames), &stack, &packed, &weight, Arithmetic::best(), dropout).unwrap()
    };
    assert_close(&found(None), &active.matmul(&weight.t().unwrap()).unwrap(), 1e-5, "the frame encoder");
    let dropout = Dropout::new(0.4, 9);
    let mut mask = vec![1.0f32; batch * 6 * coarse];
    mask.chunks_exact_mut(6 * coarse).enumerate().for_each(|(image, mask)| dropout.apply(image, mask));
    let mask = Tensor::from_vec(mask, (batch, 6 * coarse), &Device::Cpu).unwrap();
    let expected = (active * mask).unwrap().matmul(&weight.t().unwrap()).unwrap();
    assert_close(&found(Some(dropout)), &expected, 1e-5, "the frame encoder with dropout");

    let (hidden, weight) = (normal(&mut random, &[batch, 5]), normal(&mut random, &[6 * coarse, 5]));
    let (weight_bias, biases) =
        (normal(&mut random, &[6 * coarse]), [3, 4].map(|len| normal(&mut random, &[len])));
    let packed = flat(&[&kernels[0], &biases[0], &kernels[1], &biases[1], &weight_bias]);
    let layers = || FrameDecoder {
        stack: stack.clone(),
        weight: weight.clone(),
        packed: packed.clone(),
        arithmetic: Arithmetic::best(),
    };
    let found = frame_decoder(&hidden, &layers()).unwrap();
    let expected = hidden.matmul(&weight.t().unwrap()).unwrap().broadcast_add(&weight_bias).unwrap();
    let mut expected = expected.reshape((batch, 6, rows / 4, columns / 4)).unwrap();
    for (kernel, bias) in kernels.iter().zip(&biases).rev() {
        let spread = expected.relu().unwrap().conv_transpose2d(kernel, 1, 0, 2, 1).unwrap();
        expected = channelwise(&spread, bias);
    }
    assert_close(&found, &expected, 1e-5, "the frame decoder");

    let target = normal(&mut random, &[batch, 3, rows, columns]);
    let found = frame_loss(&hidden, layers(), dense(&target)).unwrap();
    let mean = (expected - target).unwrap().sqr().unwrap().mean_all().unwrap();
    assert_close(&found, &mean, 1e-5, "the frame loss");
}

#[test]
fn averaged_frames_are_the_means_of_their_squares() {
    let frame: Vec<f32> = (0..2 * 16).map(|value| value as f32).collect();
    let frames = dense(&Tensor::from_vec(frame.clone(), (1, 2, 4, 4), &Device::Cpu).unwrap());
    let averaged = Averaged::over(frames, 2);
    assert_eq!((averaged.size(), averaged.frame_len()), ([2, 2], 8));
    let mut found = vec![0.0; 8];
    averaged.write(0, &mut found);
    // The first square contains 0, 1, 4 and 5.
    assert_eq!(found, [2.5, 4.5, 10.5, 12.5, 18.5, 20.5, 26.5, 28.5]);
    // Of two rows and eight columns, it holds 0, 1, 8 and 9.
    let frames = dense(&Tensor::from_vec(frame, (1, 2, 2, 8), &Device::Cpu).unwrap());
    let averaged = Averaged::over(frames, 2);
    assert_eq!(averaged.size(), [1, 4]);
    averaged.write(0, &mut found);
    assert_eq!(found, [4.5, 6.5, 8.5, 10.5, 20.5, 22.5, 24.5, 26.5]);
}

#[test]
fn adam_takes_the_steps_of_its_algorithm() {
    // The gradients change their size and sign, so that both moments and their corrections matter.
    let gradients = [[1.0f32, -0.01], [-3.0, 0.5], [0.1, 0.0], [20.0, -2.0]];
    let parameter = Var::new(&[0.5f32, -0.25], &Device::Cpu).unwrap();
    let mut adam = Adam::new(vec![parameter.clone()], 1e-2).unwrap();
    let (mut expected, mut mean, mut square) = ([0.5f64, -0.25], [0.0f64; 2], [0.0f64; 2]);
    for (step, gradient) in gradients.iter().enumerate() {
        let slope = Tensor::new(gradient, &Device::Cpu).unwrap();
        let loss = (parameter.as_tensor() * slope).unwrap().sum_all().unwrap();
        adam.step(&loss.backward().unwrap()).unwrap();
        for index in 0..2 {
            let gradient = f64::from(gradient[index]);
            mean[index] = 0.9 * mean[index] + 0.1 * gradient;
            square[index] = 0.999 * square[index] + 0.001 * gradient * gradient;
            let corrected = |moment: f64, beta: f64| moment / (1.0 - beta.powi(step as i32 + 1));
            let spread = corrected(square[index], 0.999).sqrt();
            expected[index] -= 1e-2 * corrected(mean[index], 0.9) / (spread + 1e-8);
        }
        for (found, expected) in parameter.to_vec1::<f32>().unwrap().into_iter().zip(expected) {
            assert!((f64::from(found) - expected).abs() < 1e-6, "step {step}: {found} instead of {expected}");
        }
    }
}

#[test]
fn reference_adam_with_weight_decay_steps_as_candles_adamw() {
    let mut random = random(0);
    // There are more values than a thread processes at a time.
    let (weight, bias) = (variable(&mut random, &[300, 250]), variable(&mut random, &[250]));
    let copy = |var: &Var| Var::from_tensor(&var.as_tensor().copy().unwrap()).unwrap();
    let (theirs_weight, theirs_bias) = (copy(&weight), copy(&bias));
    let adamw = |var: &Var, weight_decay: f64| {
        let settings = ParamsAdamW { lr: 0.01, weight_decay, ..ParamsAdamW::default() };
        AdamW::new(vec![var.clone()], settings).unwrap()
    };
    let mut theirs = [adamw(&theirs_weight, 0.5), adamw(&theirs_bias, 0.0)];
    let mut ours = Adam::new(vec![weight.clone(), bias.clone()], 0.01).unwrap().with_weight_decay(0.5);
    for step in 0..5 {
        let slopes = [normal(&mut random, &[300, 250]), normal(&mut random, &[250])];
        let gradients = |weight: &Var, bias: &Var| {
            let product = |var: &Var, slope: &Tensor| (var.as_tensor() * slope)?.sum_all();
            (product(weight, &slopes[0]).unwrap() + product(bias, &slopes[1]).unwrap())
                .unwrap()
                .backward()
                .unwrap()
        };
        let learning_rate = 0.01 / f64::from(step + 1);
        ours.set_learning_rate(learning_rate);
        ours.step(&gradients(&weight, &bias)).unwrap();
        for optimizer in &mut theirs {
            optimizer.set_learning_rate(learning_rate);
            optimizer.step(&gradients(&theirs_weight, &theirs_bias)).unwrap();
        }
    }
    assert_close(&weight, &theirs_weight, 1e-6, "the weight");
    assert_close(&bias, &theirs_bias, 1e-6, "the bias, which does not decay");
}

#[test]
fn a_gradient_longer_than_the_clip_norm_is_scaled_down_to_it() {
    // The gradients of the two parameters are `times` (3, 0) and (4, 0), so their joint norm is 5 * `times`.
    let step = |adam: &mut Adam, pair: &[Var; 2], times: f32| {
        let product = |var: &Var, slope: f32| {
            let slope = Tensor::new(&[slope * times, 0.0], &Device::Cpu)?.reshape(var.shape())?;
            (var.as_tensor() * slope)?.sum_all()
        };
        let loss = (product(&pair[0], 3.0).unwrap() + product(&pair[1], 4.0).unwrap()).unwrap();
        adam.step(&loss.backward().unwrap()).unwrap();
    };
    let pair = || [Var::new(&[1.0f32, 2.0], &Device::Cpu), Var::new(&[[3.0f32], [4.0]], &Device::Cpu)];
    let [clipped, scaled, free] = [(); 3].map(|()| pair().map(Result::unwrap));
    let adam = |pair: &[Var; 2]| Adam::new(pair.to_vec(), 0.1).unwrap();
    let mut clipping = adam(&clipped).with_clip_norm(Some(10.0));
    let (mut by_hand, mut unclipped) = (adam(&scaled), adam(&free));
    // The norms are 5, 50 and 1. Only the second is above the limit of 10, by a factor of five.
    for (times, after_clipping) in [(1.0, 1.0), (10.0, 2.0), (0.2, 0.2)] {
        step(&mut clipping, &clipped, times);
        step(&mut by_hand, &scaled, after_clipping);
        step(&mut unclipped, &free, times);
    }
    for index in 0..2 {
        assert_close(&clipped[index], &scaled[index], 1e-6, "the clipped parameter");
        let moved = (clipped[index].as_tensor() - free[index].as_tensor()).unwrap().abs().unwrap();
        assert!(moved.max_all().unwrap().to_scalar::<f32>().unwrap() > 1e-3, "clipping makes a difference");
    }
}

#[test]
fn learning_rates_rise_over_the_warm_up_then_fall_to_nothing() {
    let cosine = Training {
        learning_rate: 0.2,
        epochs: 5,
        warmup_epochs: 1.0,
        schedule: Schedule::Cosine,
        ..Training::default()
    };
    // Calculated by hand for five epochs of ten steps: ten steps of warm-up, then forty of half a cosine.
    let expected = [
        (0, 0.02),
        (4, 0.1),
        (9, 0.2),
        (10, 0.2),
        (20, 0.1 + 0.1 * 0.5f64.sqrt()),
        (30, 0.1),
        (40, 0.1 - 0.1 * 0.5f64.sqrt()),
    ];
    for (step, expected) in expected {
        let found = learning_rate(&cosine, 10, step);
        assert!((found - expected).abs() < 1e-12, "step {step}: {found} instead of {expected}");
    }
    let last = learning_rate(&cosine, 10, 49);
    assert!(last > 0.0 && last < 0.001, "{last}");
    let constant = Training { schedule: Schedule::Constant, warmup_epochs: 0.25, ..cosine };
    let rates: Vec<f64> = (0..4).map(|step| learning_rate(&constant, 10, step)).collect();
    assert_eq!(rates, [0.2 * (1.0 / 2.5), 0.2 * (2.0 / 2.5), 0.2, 0.2]);
    let default = Training { warmup_epochs: 0.0, ..constant };
    assert_eq!(learning_rate(&default, 10, 0), 0.2);
}

/// The tensors that tests/fixtures/twin.py wrote, from the same network in PyTorch.
struct Twin {
    tensors: HashMap<String, Tensor>,
    weights: BTreeMap<Modality, f64>,
    kl_weight: f64,
    architecture: Architecture,
}

/// The paper's network with these widths.
fn network(hidden: usize, channels: usize) -> Network {
    Network {
        preset: Preset::MultiToMulti,
        hidden: vec![hidden],
        channels: Some(vec![channels]),
        ..Network::default()
    }
}

impl Twin {
    fn load(name: &str, frames: bool, arithmetic: Arithmetic) -> Self {
        let path = Path::new(ROOT).join(format!("tests/fixtures/twin_{name}.safetensors"));
        let bytes = std::fs::read(&path).unwrap();
        let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).unwrap();
        let settings = &header.metadata().as_ref().unwrap()["settings"];
        let settings: serde_json::Value = serde_json::from_str(settings).unwrap();
        let size = |value: &serde_json::Value| value.as_u64().unwrap() as usize;
        let sizes = |key: &str| -> Vec<usize> {
            let value = &settings[key];
            value.as_array().map_or_else(|| vec![size(value)], |values| values.iter().map(size).collect())
        };
        let fusion = settings
            .get("fusion")
            .map_or(Fusion::Early, |name| serde_json::from_value(name.clone()).unwrap());
        let memory =
            settings.get("memory").map_or(Memory::None, |name| serde_json::from_value(name.clone()).unwrap());
        let only = |modalities: &[Modality]| -> Vec<Modality> {
            modalities
                .iter()
                .copied()
                .filter(|modality| frames || !Layout::finger()[*modality].is_image())
                .collect()
        };
        Self {
            tensors: candle_core::safetensors::load_buffer(&bytes, &Device::Cpu).unwrap(),
            weights: serde_json::from_value(settings["weights"].clone()).unwrap(),
            kl_weight: settings["kl_weight"].as_f64().unwrap(),
            architecture: Architecture {
                input: only(&[Modality::PROPRIOCEPTION, Modality::VISION]),
                output: only(&[
                    Modality::PROPRIOCEPTION,
                    Modality::CONTACT_FORCE,
                    Modality::FRAME_DIFFERENCE,
                ]),
                latent: size(&settings["latent"]),
                layout: Layout::finger(),
                action: ARM_JOINTS,
                network: Network {
                    preset: Preset::MultiToMulti,
                    hidden: sizes("hidden"),
                    channels: Some(sizes("channels")),
                    fusion,
                    memory,
                    ..Network::default()
                },
                changes: BTreeMap::new(),
                hurdles: BTreeMap::new(),
                distributions: BTreeMap::new(),
                arithmetic,
            },
        }
    }

    fn get(&self, name: &str) -> &Tensor {
        self.tensors.get(name).unwrap_or_else(|| panic!("the fixture has '{name}'"))
    }

    /// Gives the parameters the values of the fixture.
    fn set(&self, parameters: &Parameters) {
        parameters.iter().for_each(|(name, parameter)| parameter.set(self.get(name)).unwrap());
    }

    fn assert_term(&self, name: &str, value: &Tensor) {
        let expected = self.get(&format!("loss.{name}"));
        assert_close(&value.reshape(1).unwrap(), expected, TWIN_TOLERANCE, &format!("the loss term {name}"));
    }

    fn assert_gradients(&self, parameters: &Parameters, gradients: &GradStore) {
        for (name, parameter) in parameters {
            let found = gradients.get(parameter).unwrap_or_else(|| panic!("a gradient of {name}"));
            let expected = self.get(&format!("grad.{name}"));
            assert_close(found, expected, TWIN_TOLERANCE, &format!("the gradient of {name}"));
        }
    }

    /// The tensors with these names that the fixture has. Those with four dimensions are images.
    fn values<const N: usize>(&self, names: [(Modality, &str); N]) -> Observation {
        let value = |(modality, name): (Modality, &str)| {
            let tensor = self.tensors.get(name)?;
            let is_image = tensor.rank() == 4;
            let value = if is_image { Value::Frames(dense(tensor)) } else { Value::Vector(tensor.clone()) };
            Some((modality, value))
        };
        names.into_iter().filter_map(value).collect()
    }
}

/// Largest difference from the values of PyTorch, relative to the largest value.
const TWIN_TOLERANCE: f64 = 1e-4;

fn assert_agrees_with_its_twin(name: &str, frames: bool, arithmetic: Arithmetic) {
    let twin = Twin::load(name, frames, arithmetic);
    let mut parameters = Parameters::new();
    let encoder = twin.architecture.encoder(&mut parameters, &mut random(0), &Device::Cpu).unwrap();
    let decoder = twin.architecture.decoder(&mut parameters, &mut random(0), &Device::Cpu).unwrap();
    twin.set(&parameters);
    let observation =
        twin.values([(Modality::PROPRIOCEPTION, "input.vector"), (Modality::VISION, "input.frame")]);
    let values = twin.values([
        (Modality::PROPRIOCEPTION, "target.proprioception"),
        (Modality::CONTACT_FORCE, "target.contact_force"),
        (Modality::FRAME_DIFFERENCE, "target.frame_difference"),
    ]);
    let targets =
        Targets { values: &values, losses: &BTreeMap::new(), parts: 1, score: Score::Loss, added: None };
    let mut adam = Adam::new(parameters.values().cloned().collect(), 1e-3).unwrap();
    for step in 0..3 {
        let posterior = encoder.encode(&observation).unwrap();
        let latent = posterior.sample(twin.get("noise")).unwrap();
        let kl = posterior.kl_divergence().unwrap();
        let mut total = (&kl * twin.kl_weight).unwrap();
        let terms = decoder.losses(&latent, Some(twin.get("action")), targets).unwrap();
        for term in &terms {
            total = (total + (term.value.get(0).unwrap() * twin.weights[&term.modality]).unwrap()).unwrap();
        }
        let gradients = total.backward().unwrap();
        if step == 0 {
            let found =
                Tensor::cat(&[posterior.mean().unwrap(), posterior.log_variance().unwrap()], 1).unwrap();
            assert_close(&found, twin.get("output.posterior"), TWIN_TOLERANCE, "the posterior");
            let decoded = decoder.decode(&latent, Some(twin.get("action"))).unwrap();
            let vectors = [Modality::PROPRIOCEPTION, Modality::CONTACT_FORCE].map(|vector| &decoded[&vector]);
            let vectors = Tensor::cat(&vectors, 1).unwrap();
            assert_close(&vectors, twin.get("output.vector"), TWIN_TOLERANCE, "the predicted vectors");
            if frames {
                assert_close(
                    &decoded[&Modality::FRAME_DIFFERENCE],
                    twin.get("output.frame"),
                    TWIN_TOLERANCE,
                    "the predicted frames",
                );
            }
            let named = terms.iter().map(|term| (term.modality.name(), &term.value));
            named
                .chain([("kl", &kl), ("total", &total)])
                .for_each(|(name, value)| twin.assert_term(name, value));
            twin.assert_gradients(&parameters, &gradients);
        }
        adam.step(&gradients).unwrap();
    }
    for (name, parameter) in &parameters {
        // Adam divides a gradient by its own size. Where a gradient is nearly zero, its sign depends on rounding. Such
        // parameters may differ by a part of the three steps of 1e-3.
        let error = (parameter.as_tensor() - twin.get(&format!("adam3.{name}"))).unwrap().abs().unwrap();
        let errors = error.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let far = errors.iter().filter(|error| **error > 2e-5).count();
        assert!(
            far * 1000 <= errors.len(),
            "{far} of {} values of {name} differ after three steps",
            errors.len()
        );
    }
}

#[test]
fn reference_convolutional_network_agrees_with_pytorch_twin() {
    assert_agrees_with_its_twin("convolutional", true, Arithmetic::best());
}

#[test]
fn reference_fully_connected_network_agrees_with_pytorch_twin() {
    assert_agrees_with_its_twin("fully_connected", false, Arithmetic::best());
}

#[test]
fn reference_the_deep_network_agrees_with_its_pytorch_twin() {
    for unit in [Unit::best(), Unit::Vectors] {
        assert_agrees_with_its_twin("deep", true, Arithmetic { unit, ..Arithmetic::best() });
    }
}

const INPUT: [Modality; 2] = [Modality::PROPRIOCEPTION, Modality::VISION];
const OUTPUT: [Modality; 3] = [Modality::PROPRIOCEPTION, Modality::CONTACT_FORCE, Modality::FRAME_DIFFERENCE];

/// The data and settings of a small training.
struct Bench {
    data: NormalizedData,
    partition: Partition,
    training: Training,
    network: Network,
}

impl Bench {
    fn new() -> Self {
        let samples = walks(4, 12);
        let partition = samples.partition(&Split::default(), &Window::TRANSITION).unwrap();
        let scalings = Modality::BUILT_IN
            .iter()
            .map(|&modality| (modality, World::paper(Scenario::EMPTY).scaling(modality, &[]).unwrap()))
            .collect();
        let normalizers = Normalizers::fit(&samples, &partition.training, &scalings, Action::Increment);
        let (samples, normalizers) = (Arc::new(samples), Arc::new(normalizers));
        let data = NormalizedData::new(samples, normalizers, Action::Increment, Device::Cpu);
        let loss_weights = BTreeMap::from([(Modality::CONTACT_FORCE, 2.0)]);
        let training =
            Training { batch_size: 8, epochs: 4, patience: None, loss_weights, ..Training::default() };
        Self { data, partition, training, network: network(8, 2) }
    }

    /// A network with several convolutions and hidden layers, and separate encoders for frames and vectors.
    fn with_deep_network() -> Self {
        let bench = Self::new();
        let deep = Network {
            hidden: vec![8, 7],
            channels: Some(vec![2, 3, 4]),
            fusion: Fusion::Late,
            ..bench.network
        };
        Self { network: deep, ..bench }
    }

    /// A training with all settings that change a step.
    fn with_schedule() -> Self {
        let mut bench = Self::new();
        bench.training = Training {
            schedule: Schedule::Cosine,
            warmup_epochs: 1.5,
            weight_decay: 1.0,
            clip_norm: Some(0.5),
            dropout: 0.2,
            distributions: [
                (Modality::PROPRIOCEPTION, Family::Gaussian),
                (Modality::CONTACT_FORCE, Family::Hurdle),
            ]
            .into(),
            ..bench.training
        };
        bench
    }

    fn architecture(&self) -> Architecture {
        Architecture {
            input: INPUT.to_vec(),
            output: OUTPUT.to_vec(),
            latent: 3,
            layout: Layout::finger(),
            action: ARM_JOINTS,
            network: self.network.clone(),
            arithmetic: Arithmetic::best(),
            changes: BTreeMap::new(),
            hurdles: BTreeMap::new(),
            distributions: self.training.distributions.clone(),
        }
        .scaled(&self.data.normalizers)
    }

    /// Describes the trained network.
    fn description(&self) -> Description {
        let (losses, normalizers) = (&self.training.losses, &self.data.normalizers);
        let window = &Window::TRANSITION;
        Description::new(
            &self.architecture(),
            Task::Prediction,
            Action::Increment,
            losses,
            normalizers,
            window,
        )
        .unwrap()
    }

    /// Trains from the beginning or from `state`, and returns the epochs and the parameters.
    fn train(
        &self,
        seed: u64,
        state: &StateFile,
        progress: &dyn Progress,
    ) -> std::result::Result<(Vec<Epoch>, Parameters), LearningError> {
        let architecture = self.architecture();
        let mut parameters = Parameters::new();
        let mut random = random(seed);
        let objective = Prediction {
            data: &self.data,
            network: architecture.network(&mut parameters, &mut random, &Device::Cpu)?,
            window: &Window::TRANSITION,
            input: &INPUT,
            output: &OUTPUT,
            training: &self.training,
            score: Score::Loss,
        };
        let partition = &self.partition;
        let fit = Fit {
            task: Task::Prediction,
            training: &self.training,
            seed,
            partition,
            state,
            progress,
            log: &|_| (),
        };
        let epochs = fit.run(&objective, &parameters)?;
        Ok((epochs, parameters))
    }

    fn train_undisturbed(&self, seed: u64) -> (Vec<Epoch>, Parameters) {
        self.train(seed, &StateFile::none(), &harness_shared::progress::Silent).unwrap()
    }
}

fn bits(parameters: &Parameters) -> Vec<u32> {
    let values = |var: &Var| var.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    parameters.values().flat_map(values).map(f32::to_bits).collect()
}

fn losses(epochs: &[Epoch]) -> Vec<u64> {
    let values = epochs.iter().flat_map(|epoch| epoch.train.values().chain(epoch.validation.values()));
    values.map(|value| value.to_bits()).collect()
}

#[test]
fn a_training_depends_on_its_seed_alone() {
    for bench in [Bench::new(), Bench::with_schedule(), Bench::with_deep_network()] {
        let with_threads = |threads: usize, seed: u64| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let (epochs, parameters) = pool.install(|| bench.train_undisturbed(seed));
            (losses(&epochs), bits(&parameters))
        };
        let once = with_threads(1, 7);
        assert!(once == with_threads(1, 7), "the same again");
        assert!(once == with_threads(3, 7), "on three threads");
        assert!(once != with_threads(1, 8), "another seed");
    }
}

#[test]
fn schedule_warm_up_decay_clipping_and_losses_change_a_training() {
    let bench = Bench::new();
    let plain = bench.training.clone();
    let changes: [(&str, Training); 5] = [
        ("schedule", Training { schedule: Schedule::Cosine, ..plain.clone() }),
        ("warm-up", Training { warmup_epochs: 1.0, ..plain.clone() }),
        ("weight decay", Training { weight_decay: 1.0, ..plain.clone() }),
        ("clipping", Training { clip_norm: Some(0.1), ..plain.clone() }),
        ("loss", Training { losses: [(Modality::CONTACT_FORCE, Loss::Huber)].into(), ..plain }),
    ];
    let (_, unchanged) = bench.train_undisturbed(7);
    for (what, training) in changes {
        let (_, changed) = Bench { training, ..Bench::new() }.train_undisturbed(7);
        assert!(bits(&changed) != bits(&unchanged), "{what}");
    }
}

/// Cancels after this many steps.
struct Impatient(AtomicUsize);

impl Progress for Impatient {
    fn begin(&self, _: &str, _: u64, _: &str) {}
    fn advance(&self, _: u64) {}
    fn note(&self, _: &str) {}
    fn say(&self, _: &str) {}
    fn end(&self) {}
    fn cancelled(&self) -> bool {
        self.0.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(1)).is_err()
    }
}

/// Trains parameters without a saved state. Returns the epochs.
fn fit(
    objective: &dyn Objective,
    parameters: &Parameters,
    training: &Training,
    partition: &Partition,
) -> Vec<Epoch> {
    let (state, progress) = (StateFile::none(), &harness_shared::progress::Silent);
    let task = Task::Prediction;
    let fit = Fit { task, training, seed: 0, partition, state: &state, progress, log: &|_| () };
    fit.run(objective, parameters).unwrap()
}

/// The samples at these positions.
fn at(positions: impl IntoIterator<Item = usize>) -> Vec<Sample> {
    positions.into_iter().map(Sample::at).collect()
}

/// An objective that records the transitions of each call, and whether it is for training. There is nothing to learn.
struct Protocol {
    parameter: Tensor,
    asked: RefCell<Vec<(bool, Vec<Sample>)>>,
}

impl Protocol {
    /// The transitions of all calls for training or for validation, in order.
    fn asked(&self, training: bool) -> Vec<Sample> {
        let asked = self.asked.borrow();
        asked.iter().filter(|(sampled, _)| *sampled == training).flat_map(|(_, at)| at.clone()).collect()
    }
}

impl Objective for Protocol {
    fn terms(&self, at: &[Sample], draw: Draw) -> Result<Vec<Weighted>> {
        self.asked.borrow_mut().push((matches!(draw, Draw::Sample { .. }), at.to_vec()));
        Ok(vec![Weighted { name: "nothing".into(), weight: 1.0, value: self.parameter.sqr()? }])
    }

    fn detached(&self) -> Box<dyn Objective + '_> {
        Box::new(self)
    }
}

impl Objective for &Protocol {
    fn terms(&self, at: &[Sample], draw: Draw) -> Result<Vec<Weighted>> {
        (*self).terms(at, draw)
    }

    fn detached(&self) -> Box<dyn Objective + '_> {
        (*self).detached()
    }
}

#[test]
fn epochs_visit_every_transition_once_in_orders_of_their_own() {
    let parameter = Var::new(1.0f32, &Device::Cpu).unwrap();
    let protocol = Protocol { parameter: parameter.as_tensor().clone(), asked: RefCell::default() };
    let parameters = Parameters::from([("parameter".to_owned(), parameter)]);
    let partition = Partition { training: at(0..10), validation: at(20..23), test: at([30]) };
    let training = Training { epochs: 3, batch_size: 4, patience: None, ..Training::default() };
    fit(&protocol, &parameters, &training, &partition);
    let orders: Vec<Vec<Sample>> = protocol.asked(true).chunks(10).map(<[Sample]>::to_vec).collect();
    assert_eq!(orders.len(), 3);
    for order in &orders {
        let mut sorted = order.clone();
        sorted.sort();
        assert_eq!(sorted, partition.training);
        assert_eq!(orders.iter().filter(|other| *other == order).count(), 1, "{orders:?}");
    }
    assert_eq!(
        protocol.asked(false),
        at(20..23).repeat(3),
        "validation uses the mean, and nothing of the test"
    );
    let sizes: Vec<usize> = protocol.asked.borrow().iter().map(|(_, at)| at.len()).collect();
    assert_eq!(sizes, [4, 4, 2, 3].repeat(3));
}

#[test]
fn an_interrupted_training_ends_as_an_undisturbed_one() {
    for bench in [Bench::new(), Bench::with_schedule()] {
        let (epochs, parameters) = bench.train_undisturbed(7);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("state.safetensors");
        let state = || StateFile::at(path.clone()).every(Duration::ZERO);
        let steps_per_epoch = bench.partition.training.len().div_ceil(bench.training.batch_size);
        // This is in the middle of the second epoch, so a part of it is lost.
        let stopped = bench.train(7, &state(), &Impatient(AtomicUsize::new(steps_per_epoch + 1)));
        assert!(matches!(stopped, Err(LearningError::Cancelled)));
        assert!(path.exists(), "the first epoch was saved");
        let (resumed_epochs, resumed) = bench.train(7, &state(), &harness_shared::progress::Silent).unwrap();
        assert_eq!(losses(&epochs), losses(&resumed_epochs));
        assert!(bits(&parameters) == bits(&resumed));
    }
}

/// Records all messages.
#[derive(Default)]
struct Listener(std::sync::Mutex<Vec<String>>);

impl Progress for Listener {
    fn begin(&self, _: &str, _: u64, _: &str) {}
    fn advance(&self, _: u64) {}
    fn note(&self, _: &str) {}
    fn say(&self, text: &str) {
        self.0.lock().unwrap().push(text.to_owned());
    }
    fn end(&self) {}
}

/// Records all calls about the stage, in order.
#[derive(Default)]
struct Heard(std::sync::Mutex<Vec<String>>);

impl Heard {
    fn hear(&self, text: String) {
        self.0.lock().unwrap().push(text);
    }
}

impl Progress for Heard {
    fn begin(&self, stage: &str, total: u64, unit: &str) {
        self.hear(format!("begin {stage}, {total} {unit}"));
    }
    fn resume(&self, steps: u64) {
        self.hear(format!("resume {steps}"));
    }
    fn advance(&self, steps: u64) {
        self.hear(format!("advance {steps}"));
    }
    fn note(&self, text: &str) {
        self.hear(text.to_owned());
    }
    fn say(&self, _: &str) {}
    fn end(&self) {
        self.hear("end".to_owned());
    }
}

#[test]
fn a_training_tells_its_losses_before_it_counts_the_epoch() {
    let bench = Bench::new();
    let heard = Heard::default();
    let (epochs, _) = bench.train(7, &StateFile::none(), &heard).unwrap();
    let mut expected = vec!["begin prediction, 4 epochs".to_owned(), "resume 0".to_owned()];
    let mut lowest = (f64::INFINITY, 0);
    for Epoch { epoch, train, validation, .. } in &epochs {
        let (train, validation) = (train[TOTAL], validation[TOTAL]);
        let best = if validation < lowest.0 {
            lowest = (validation, *epoch);
            "lowest so far".to_owned()
        } else {
            format!("lowest {:.4} in epoch {}", lowest.0, lowest.1)
        };
        expected.push(format!("validation {validation:.4}, {best}, training {train:.4}"));
        expected.push("advance 1".to_owned());
    }
    expected.push("end".to_owned());
    assert_eq!(heard.0.into_inner().unwrap(), expected);
}

#[test]
fn a_cancelled_training_keeps_its_last_whole_epoch() {
    let bench = Bench::new();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("state.safetensors");
    // The interval is so long that the state is only saved when the training is cancelled.
    let state = || StateFile::at(path.clone()).every(Duration::from_secs(3600));
    let steps_per_epoch = bench.partition.training.len().div_ceil(bench.training.batch_size);
    let epochs = bench.training.epochs;
    // This is in the middle of the last epoch.
    let patience = Impatient(AtomicUsize::new(steps_per_epoch * epochs - 1));
    assert!(matches!(bench.train(7, &state(), &patience), Err(LearningError::Cancelled)));
    // Only the last epoch is done again.
    let (all, _) = bench.train(7, &state(), &Impatient(AtomicUsize::new(steps_per_epoch))).unwrap();
    assert_eq!(losses(&all), losses(&bench.train_undisturbed(7).0));
}

#[test]
fn a_damaged_state_is_named_and_not_used() {
    let bench = Bench::new();
    let (_, parameters) = bench.train_undisturbed(7);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("state.safetensors");
    let state = || StateFile::at(path.clone());
    let steps_per_epoch = bench.partition.training.len().div_ceil(bench.training.batch_size);
    let impatient = Impatient(AtomicUsize::new(steps_per_epoch + 1));
    assert!(bench.train(7, &state().every(Duration::ZERO), &impatient).is_err());
    let whole = std::fs::read(&path).unwrap();
    for part in 0..100 {
        let at = whole.len() * part / 100;
        let mut flipped = whole.clone();
        flipped[at] ^= 1 << (part % 8);
        for damaged in [&flipped[..], &whole[..at]] {
            std::fs::write(&path, damaged).unwrap();
            let listener = Listener::default();
            let (_, anew) = bench.train(7, &state(), &listener).unwrap();
            assert!(bits(&parameters) == bits(&anew), "part {part}");
            let said = listener.0.into_inner().unwrap();
            let [said] = said.as_slice() else { panic!("part {part}: {said:?}") };
            assert!(said.starts_with(&format!("{} is damaged (", path.display())), "{said}");
            assert!(said.ends_with("its training starts again"), "{said}");
        }
    }
}

#[test]
fn early_stopping_keeps_the_best_epoch() {
    let mut bench = Bench::new();
    // With such large steps, the validation loss rises after a few epochs.
    bench.training =
        Training { epochs: 60, patience: Some(3), learning_rate: 0.05, batch_size: 8, ..Training::default() };
    let (epochs, parameters) = bench.train_undisturbed(7);
    let loss = |epoch: &Epoch| epoch.validation[TOTAL];
    let best = epochs.iter().min_by(|a, b| loss(a).total_cmp(&loss(b))).unwrap().epoch;
    assert!(epochs.len() < 60, "it stopped early");
    assert_eq!(epochs.len(), best + 3);
    let shorter = Training { epochs: best, patience: None, ..bench.training.clone() };
    let (_, best_parameters) = Bench { training: shorter, ..bench }.train_undisturbed(7);
    assert!(bits(&parameters) == bits(&best_parameters));
}

/// An objective with given validation errors for each epoch, and a KL divergence that always falls.
struct Scripted {
    parameter: Tensor,
    /// The errors of proprioception and contact force in each epoch.
    errors: Vec<[f32; 2]>,
    epoch: Cell<usize>,
    /// The parameter after each epoch.
    reached: RefCell<Vec<f32>>,
}

impl Objective for Scripted {
    fn terms(&self, _: &[Sample], draw: Draw) -> Result<Vec<Weighted>> {
        let term = |name: &str, weight: f64, value: f32| -> Result<Weighted> {
            // The parameter always changes in the same direction, and does not change the value.
            let falling = (&self.parameter - self.parameter.detach())?;
            Ok(Weighted { name: name.into(), weight, value: (falling + f64::from(value))? })
        };
        let epoch = self.epoch.get();
        if matches!(draw, Draw::Mean) {
            self.reached.borrow_mut().push(self.parameter.to_scalar()?);
            self.epoch.set(epoch + 1);
        }
        let [angles, forces] = self.errors[epoch];
        Ok(vec![
            term("proprioception", 1.0, angles)?,
            term("contact_force", 1.0, forces)?,
            term("kl", 1e-3, -(epoch as f32))?,
        ])
    }

    fn detached(&self) -> Box<dyn Objective + '_> {
        Box::new(self)
    }
}

impl Objective for &Scripted {
    fn terms(&self, at: &[Sample], draw: Draw) -> Result<Vec<Weighted>> {
        (*self).terms(at, draw)
    }

    fn detached(&self) -> Box<dyn Objective + '_> {
        (*self).detached()
    }
}

#[test]
fn patience_counts_from_the_best_total_or_last_improved_term() {
    let errors = [[1.0, 1.0], [0.5, 1.1], [0.4, 1.1], [0.7, 0.9], [0.6, 0.95], [0.6, 1.0], [0.6, 1.0]];
    let epochs = |stop: Stop| {
        let parameter = Var::new(1.0f32, &Device::Cpu).unwrap();
        let scripted = Scripted {
            parameter: parameter.as_tensor().clone(),
            errors: errors.to_vec(),
            epoch: Cell::default(),
            reached: RefCell::default(),
        };
        let parameters = Parameters::from([("parameter".to_owned(), parameter.clone())]);
        let partition = Partition { training: at([0]), validation: at([1]), test: at([2]) };
        let training = Training { epochs: 7, patience: Some(2), stop, ..Training::default() };
        let done = fit(&scripted, &parameters, &training, &partition).len();
        let kept = parameter.to_scalar::<f32>().unwrap();
        assert_eq!(kept, scripted.reached.borrow()[2], "the parameters of the third epoch, the best total");
        done
    };
    assert_eq!(epochs(Stop::Total), 3 + 2);
    assert_eq!(epochs(Stop::EveryTerm), 4 + 2, "the fourth epoch has the best force");
}

#[test]
fn a_loss_that_is_not_finite_ends_the_training() {
    let mut bench = Bench::new();
    bench.training.learning_rate = 1e30;
    let error = bench.train(7, &StateFile::none(), &harness_shared::progress::Silent).err().unwrap();
    assert!(matches!(error, LearningError::NotFinite { .. }), "{error}");
}

/// An objective that is finite on training samples, and infinite on validation samples.
struct InfiniteOnValidation(Tensor);

impl Objective for InfiniteOnValidation {
    fn terms(&self, _: &[Sample], draw: Draw) -> Result<Vec<Weighted>> {
        let infinite = if matches!(draw, Draw::Mean) { f64::INFINITY } else { 1.0 };
        let term = |name: &str, value: f64| -> Result<Weighted> {
            Ok(Weighted { name: name.into(), weight: 1.0, value: (&self.0 * value)? })
        };
        Ok(vec![term("contact_force", infinite)?, term("kl", 1.0)?])
    }

    fn detached(&self) -> Box<dyn Objective + '_> {
        Box::new(Self(self.0.clone()))
    }
}

#[test]
fn a_validation_loss_that_is_not_finite_is_named_with_its_terms() {
    let parameter = Var::new(1.0f32, &Device::Cpu).unwrap();
    let objective = InfiniteOnValidation(parameter.as_tensor().clone());
    let parameters = Parameters::from([("parameter".to_owned(), parameter)]);
    let partition = Partition { training: at([0]), validation: at([1]), test: at([2]) };
    let (training, state) = (Training::default(), StateFile::none());
    let fit = Fit {
        task: Task::Prediction,
        training: &training,
        seed: 0,
        partition: &partition,
        state: &state,
        progress: &harness_shared::progress::Silent,
        log: &|_| (),
    };
    let error = fit.run(&objective, &parameters).err().unwrap().to_string();
    assert_eq!(
        error,
        "the validation loss of the prediction was no longer finite in epoch 1 (contact_force inf, total inf); try a \
         smaller training.learning_rate"
    );
}

#[test]
fn checkpoints_bring_back_parameters_and_scales() {
    let bench = Bench::new();
    let (_, trained) = bench.train_undisturbed(7);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("network.safetensors");
    let saved = bench.data.normalizers.clone();
    checkpoint::save(&path, &trained, &saved, &bench.description()).unwrap();
    let (_, other) = bench.train_undisturbed(8);
    assert!(bits(&trained) != bits(&other));
    let normalizers = checkpoint::load(&path, &other).unwrap();
    assert!(bits(&trained) == bits(&other));
    assert_eq!(normalizers, *saved);
    // Forces have a minimum, and angles have none.
    let minimum = |modality| normalizers.modalities[&modality].minimum;
    assert_eq!((minimum(Modality::CONTACT_FORCE), minimum(Modality::PROPRIOCEPTION)), (Some(0.0), None));
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let error = checkpoint::load(&path, &other).unwrap_err();
    assert!(error.to_string().contains("network.safetensors is damaged"), "{error}");
}

#[test]
fn checkpoints_describe_their_network() {
    let bench = Bench::with_deep_network();
    let (_, trained) = bench.train_undisturbed(7);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("network.safetensors");
    checkpoint::save(&path, &trained, &bench.data.normalizers, &bench.description()).unwrap();
    let note = TensorFile::read(&path).unwrap().note;
    assert_eq!(note["network"].to_string(), bench.description().json());
    assert_eq!(note["network"]["outputs"][1]["minimum"], 0.0);
}

#[test]
fn normalized_values_have_mean_0_and_deviation_1_and_restore() {
    let bench = Bench::new();
    let at = &bench.partition.training;
    let normalizers = &bench.data.normalizers;
    let mut values = normalizers.vectors(&bench.data.samples, at, &[Modality::ARM]);
    let table = Tensor::from_slice(&values, (at.len(), values.len() / at.len()), &Device::Cpu).unwrap();
    let mean = table.mean(0).unwrap().to_vec1::<f32>().unwrap();
    let square = table.sqr().unwrap().mean(0).unwrap().to_vec1::<f32>().unwrap();
    assert!(mean.iter().all(|mean| mean.abs() < 1e-4), "{mean:?}");
    assert!(square.iter().all(|square| (square - 1.0).abs() < 1e-3), "{square:?}");
    normalizers.modalities[&Modality::ARM].denormalize(&mut values);
    let physical = at.iter().flat_map(|sample| bench.data.samples.vector(Modality::ARM, *sample).to_vec());
    assert!(values.iter().zip(physical).all(|(value, physical)| (value - physical).abs() < 1e-5));
}

#[test]
fn a_deviation_is_scaled_by_its_elements_own_without_the_mean() {
    let normalizer = Normalizer { mean: vec![5.0, 7.0], std: vec![2.0, 3.0], minimum: Some(100.0) };
    let mut deviations = vec![1.0, 1.0, -2.0, 0.5];
    normalizer.denormalize_deviations(&mut deviations);
    assert_eq!(deviations, [2.0, 3.0, -4.0, 1.5]);
}

#[test]
fn a_frame_difference_is_what_changed_since_the_sample_before() {
    let samples = walks(2, 3);
    let first = Sample::at(samples.episodes()[1].start);
    assert!(
        harness_samples::frame_difference(&samples, Modality::FRAME_DIFFERENCE, first)
            .all(|change| change == 0.0)
    );
    let change: Vec<f32> =
        harness_samples::frame_difference(&samples, Modality::FRAME_DIFFERENCE, first.after(1)).collect();
    let (now, before) =
        (samples.frame_bytes(Modality::VISION, first.after(1)), samples.frame_bytes(Modality::VISION, first));
    assert_eq!(change[5], (f32::from(now[5]) - f32::from(before[5])) / 255.0);
    assert!(change.iter().any(|change| *change != 0.0));
}

#[test]
fn transitions_never_cross_episodes_and_splits_never_share_one() {
    let samples = walks(5, 6);
    let Partition { training, validation, test } =
        samples.partition(&Split::default(), &Window::TRANSITION).unwrap();
    let episode = |transitions: &[Sample]| -> Vec<usize> {
        transitions.iter().map(|sample| samples.place(*sample).0).collect()
    };
    assert_eq!(training.len(), 3 * 5);
    assert!(episode(&training).iter().all(|episode| *episode < 3));
    assert!(episode(&validation).iter().all(|episode| *episode == 3));
    assert!(episode(&test).iter().all(|episode| *episode == 4));
    for sample in training.iter().chain(&validation).chain(&test) {
        assert_eq!(samples.place(*sample).0, samples.place(sample.after(1)).0);
    }
}

#[test]
fn a_term_of_the_loss_is_a_finite_scalar() {
    let bench = Bench::new();
    let (epochs, _) = bench.train_undisturbed(7);
    let last = epochs.last().unwrap();
    let names: Vec<&str> = last.train.keys().map(String::as_str).collect();
    assert_eq!(names, ["contact_force", "frame_difference", "kl", "proprioception", "total"]);
    let term = |name: &str| last.train[name];
    let sum =
        term("proprioception") + 2.0 * term("contact_force") + term("frame_difference") + 1e-4 * term("kl");
    assert!((sum - term(TOTAL)).abs() < 1e-4 * sum, "{sum} is not {}", term(TOTAL));
    assert_eq!(scalar(&Tensor::new(2.5f32, &Device::Cpu).unwrap()).unwrap(), 2.5);
}

/// Returns the names of all parameters in a network's description, sorted.
fn described_parameters(architecture: &Architecture) -> Vec<String> {
    let normalizers = Bench::new().data.normalizers;
    let losses = BTreeMap::new();
    let description = Description::new(
        architecture,
        Task::Prediction,
        Action::Increment,
        &losses,
        &normalizers,
        &Window::TRANSITION,
    )
    .unwrap();
    let text: serde_json::Value = serde_json::from_str(&description.json()).unwrap();
    let layers = ["encoder", "decoder"].into_iter().flat_map(|part| text[part].as_array().unwrap());
    let values = layers.flat_map(|layer| {
        let weights = layer["weights"].as_array().into_iter().flatten();
        weights.chain(["weight", "bias"].into_iter().filter_map(|key| layer.get(key)))
    });
    let mut names: Vec<String> = values.map(|name| name.as_str().unwrap().to_owned()).collect();
    names.sort();
    names
}

#[test]
fn the_number_of_parameters_is_known_before_they_are_made() {
    let sides: [&[Modality]; 4] = [
        &[Modality::ARM],
        &[Modality::PROPRIOCEPTION, Modality::CONTACT_FORCE],
        &[Modality::VISION],
        &[Modality::PROPRIOCEPTION, Modality::VISION, Modality::FRAME_DIFFERENCE],
    ];
    for (input, output) in sides.iter().flat_map(|input| sides.iter().map(move |output| (input, output))) {
        for (fusion, hidden) in [
            (Fusion::Early, vec![7]),
            (Fusion::Early, vec![5, 6]),
            (Fusion::Late, vec![7, 4]),
            (Fusion::Product, vec![7, 4]),
        ] {
            let architecture = Architecture {
                input: input.to_vec(),
                output: output.to_vec(),
                latent: 3,
                layout: Layout::finger(),
                action: ARM_JOINTS,
                network: Network { hidden, channels: Some(vec![2, 5]), fusion, ..network(0, 0) },
                arithmetic: Arithmetic::best(),
                changes: BTreeMap::new(),
                hurdles: BTreeMap::new(),
                distributions: BTreeMap::new(),
            };
            let mut parameters = Parameters::new();
            architecture.encoder(&mut parameters, &mut random(0), &Device::Cpu).unwrap();
            architecture.decoder(&mut parameters, &mut random(0), &Device::Cpu).unwrap();
            let made: usize = parameters.values().map(|parameter| parameter.elem_count()).sum();
            let summary = architecture.summary().unwrap();
            assert_eq!(summary.parameters(), made, "{input:?} to {output:?}, {fusion}");
            assert_eq!(described_parameters(&architecture), parameters.into_keys().collect::<Vec<_>>());
        }
    }
}
