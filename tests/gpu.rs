//! Every op and every kind of network on a GPU, compared with the CPU.
//!
//! A test prints the relative difference of each result, ‖gpu - cpu‖ / ‖cpu‖, as `name result difference`. These tests
//! need a GPU, so they are built only with `--features cuda`:
//!
//!     cargo test --features cuda --test gpu -- --nocapture --test-threads 1

use candle_core::{Device, Result, Tensor, Var};
use harness_kernels::product::{Arithmetic, Precision, Unit};
use harness_learning::data::NormalizedData;
use harness_learning::network::{Architecture, Draw, Observation, Parameters, Score, Seen, Targets, Value};
use harness_learning::objective::Prediction;
use harness_learning::open_device;
use harness_learning::random::{Random, Stream};
use harness_learning::state::StateFile;
use harness_learning::training::{Epoch, Fit};
use harness_ops::frames::{Averaged, DenseFrames, Frames, part, stacked};
use harness_ops::{
    Adam, Dropout, FrameDecoder, Gated, Quantity, Sequences, Stack, StateSpace, TwoLayers,
    balanced_divergence, frame_decoder, frame_encoder, frame_loss, gru, kl_divergence, linear, norm, rssm,
    sample, two_layers, vector_losses,
};
use harness_samples::{Normalizers, Partition};
use harness_shared::progress::Silent;
use harness_spec::{
    Action, Fusion, Layout, Loss, Memory, Modality, Network, Preset, Scenario, Split, Task, Training, Window,
    World,
};
use std::collections::BTreeMap;
use std::sync::Arc;

#[path = "common/finger.rs"]
mod finger;
#[path = "common/walks.rs"]
mod walks;

/// The largest relative difference of a result in f32.
const BOUND: f64 = 2e-5;
/// The same with factors rounded to TF32.
const BOUND_TF32: f64 = 5e-3;

fn gpu() -> Device {
    open_device(harness_spec::Device::Cuda).expect("a GPU")
}

fn random(seed: u64) -> Random {
    Random::new(seed, Stream::Parameters(Task::Prediction))
}

fn normal(random: &mut Random, shape: &[usize]) -> Tensor {
    Tensor::from_vec(random.normal(shape.iter().product()), shape, &Device::Cpu).unwrap()
}

fn arithmetic(precision: Precision) -> Arithmetic {
    Arithmetic { unit: Unit::Vectors, precision }
}

const F32: Arithmetic = Arithmetic { unit: Unit::Vectors, precision: Precision::F32 };

fn values(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().unwrap().to_device(&Device::Cpu).unwrap().to_vec1().unwrap()
}

/// Compares a result with that of the CPU, and prints the relative difference.
fn compare(name: &str, what: &str, found: &Tensor, expected: &Tensor, bound: f64) {
    assert_eq!(found.dims(), expected.dims(), "shape of {name}, {what}");
    let (found, expected) = (values(found), values(expected));
    let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|value| value * value).sum::<f64>().sqrt();
    let difference = norm(
        &mut found.iter().zip(&expected).map(|(found, expected)| f64::from(*found) - f64::from(*expected)),
    );
    let scale = norm(&mut expected.iter().map(|value| f64::from(*value)));
    let relative = if difference == 0.0 { 0.0 } else { difference / scale.max(1e-30) };
    println!("gpu: {name} | {what} | {relative:.2e}");
    assert!(relative <= bound, "{name}: {what} differs by {relative:e}");
}

/// Computes a function and its gradients on both devices.
fn check(name: &str, arguments: &[Tensor], bound: f64, function: impl Fn(&[Tensor]) -> Result<Tensor>) {
    let run = |device: &Device| {
        let arguments: Vec<Var> = arguments
            .iter()
            .map(|argument| Var::from_tensor(&argument.to_device(device).unwrap()).unwrap())
            .collect();
        let tensors: Vec<Tensor> = arguments.iter().map(|var| var.as_tensor().clone()).collect();
        let result = function(&tensors).unwrap();
        let weights = normal(&mut random(7), result.dims()).to_device(device).unwrap();
        let gradients = (&result * &weights).unwrap().sum_all().unwrap().backward().unwrap();
        let gradients: Vec<_> = arguments.iter().map(|argument| gradients.get(argument).cloned()).collect();
        (result, gradients)
    };
    let ((found, of_gpu), (expected, of_cpu)) = (run(&gpu()), run(&Device::Cpu));
    compare(name, "result", &found, &expected, bound);
    for (index, (found, expected)) in of_gpu.iter().zip(&of_cpu).enumerate() {
        match (found, expected) {
            (Some(found), Some(expected)) => {
                compare(name, &format!("gradient {}", index + 1), found, expected, bound);
            }
            (None, None) => {}
            _ => panic!("{name}: only one device has gradient {}", index + 1),
        }
    }
}

#[test]
fn fully_connected_layers() {
    let mut random = random(1);
    for [batch, inputs, outputs] in [[1, 1, 1], [7, 5, 3], [100, 33, 65], [1024, 256, 256]] {
        let arguments =
            [[batch, inputs], [outputs, inputs]].map(|shape| normal(&mut random, &shape)).into_iter();
        let arguments: Vec<Tensor> = arguments.chain([normal(&mut random, &[outputs])]).collect();
        for relu in [false, true] {
            let name = format!("linear {batch}x{inputs}x{outputs} relu={relu}");
            check(&name, &arguments, BOUND, |x| linear(&x[0], &x[1], &x[2], relu, F32));
        }
        check(&format!("linear {batch}x{inputs}x{outputs} tf32"), &arguments, BOUND_TF32, |x| {
            linear(&x[0], &x[1], &x[2], false, arithmetic(Precision::Tf32))
        });
    }
    let shapes: [&[usize]; 5] = [&[50, 11], &[17, 11], &[17], &[6, 17], &[6]];
    let arguments = shapes.map(|shape| normal(&mut random, shape));
    check("two layers", &arguments, BOUND, |x| {
        let layers = TwoLayers { hidden_weight: &x[1], hidden_bias: &x[2], weight: &x[3], bias: &x[4] };
        two_layers(&x[0], layers, F32)
    });
}

#[test]
fn normalizations_and_losses() {
    let mut random = random(2);
    for [batch, width] in [[1, 5], [9, 3], [1024, 256], [33, 700]] {
        let shapes: [&[usize]; 3] = [&[batch, width], &[width], &[width]];
        let arguments = shapes.map(|shape| normal(&mut random, shape));
        check(&format!("norm {batch}x{width}"), &arguments, BOUND, |x| norm(&x[0], &x[1], &x[2], 1e-5));
    }
    for parts in [1, 4] {
        let [predicted, target] = [(); 2].map(|()| normal(&mut random, &[40, 12]));
        let quantities = [(5, Loss::Squared), (4, Loss::Absolute), (3, Loss::Huber)]
            .map(|(width, loss)| Quantity { width, loss });
        check(&format!("vector losses in {parts} parts"), &[predicted], BOUND, |x| {
            vector_losses(&x[0], &target.to_device(x[0].device())?, &quantities, parts)
        });
    }
}

#[test]
fn distributions() {
    let mut random = random(3);
    for [batch, latent] in [[1, 1], [13, 5], [1024, 64]] {
        let [posterior, prior] = [(); 2].map(|()| normal(&mut random, &[batch, 2 * latent]));
        let noise = normal(&mut random, &[batch, latent]);
        let name = |op: &str| format!("{op} {batch}x{latent}");
        check(&name("sample"), std::slice::from_ref(&posterior), BOUND, |x| {
            sample(&x[0], &noise.to_device(x[0].device())?)
        });
        check(&name("divergence"), std::slice::from_ref(&posterior), BOUND, |x| kl_divergence(&x[0]));
        check(&name("balanced divergence"), &[posterior, prior], BOUND, |x| {
            balanced_divergence(&x[0], &x[1], 0.5 * latent as f64, 0.1)
        });
    }
}

#[test]
fn recurrent_units() {
    let mut random = random(4);
    // The batch, the times, the columns and the width.
    let sizes = [[1, 1, 1, 1], [3, 4, 7, 5], [20, 50, 132, 256], [300, 3, 20, 65], [2, 30, 9, 300]];
    for [batch, times, columns, width] in sizes {
        let shapes: [&[usize]; 6] = [
            &[times * batch, columns],
            &[3 * width, columns],
            &[3 * width],
            &[3 * width, width],
            &[3 * width],
            &[batch, width],
        ];
        // Weights of a trained network are smaller than 1.
        let arguments = shapes.map(|shape| (normal(&mut random, shape) / (width as f64).sqrt()).unwrap());
        check(&format!("gru {batch}x{times}x{columns}x{width}"), &arguments, BOUND, |x| {
            let input = Gated { weight: &x[1], bias: &x[2] };
            gru(&x[0], input, Gated { weight: &x[3], bias: &x[4] }, &x[5], F32)
        });
    }
}

#[test]
fn state_space_models() {
    let mut random = random(5);
    // The batch, the times, the action, the encoded columns, the width, the hidden layer and the latent state.
    let sizes = [
        [1, 1, 1, 1, 1, 1, 1],
        [3, 4, 2, 6, 5, 7, 3],
        [20, 50, 3, 128, 256, 256, 64],
        [130, 3, 2, 10, 33, 70, 17],
    ];
    for [batch, times, action, columns, width, units, latent] in sizes {
        let rows = times * batch;
        let shapes: [&[usize]; 12] = [
            &[rows, action],
            &[rows, columns],
            &[3 * width, latent + action],
            &[3 * width],
            &[3 * width, width],
            &[3 * width],
            &[units, width + columns],
            &[units],
            &[2 * latent, units],
            &[2 * latent],
            &[batch, width],
            &[batch, latent],
        ];
        let arguments = shapes.map(|shape| (normal(&mut random, shape) / (width as f64).sqrt()).unwrap());
        let noise = normal(&mut random, &[rows, latent]);
        for drawn in [true, false] {
            let name = format!("rssm {batch}x{times} width {width} latent {latent} drawn={drawn}");
            check(&name, &arguments, BOUND, |x| {
                let noise = noise.to_device(x[0].device())?;
                let given =
                    Sequences { actions: &x[0], encoded: Some(&x[1]), noise: drawn.then_some(&noise) };
                let parameters = StateSpace {
                    input: Gated { weight: &x[2], bias: &x[3] },
                    hidden: Gated { weight: &x[4], bias: &x[5] },
                    distribution: TwoLayers {
                        hidden_weight: &x[6],
                        hidden_bias: &x[7],
                        weight: &x[8],
                        bias: &x[9],
                    },
                };
                let (memory, distribution) = rssm(&given, &parameters, &x[10], &x[11], F32)?;
                Tensor::cat(&[memory, distribution], 1)
            });
        }
    }
}

#[test]
fn convolutions_of_frames() {
    let mut random = random(6);
    // The batch, the frames' channels, rows and columns, and the channels of the convolutions.
    let sizes: [(usize, usize, [usize; 2], &[usize]); 7] = [
        (1, 3, [8, 8], &[2]),
        (19, 3, [16, 24], &[4, 6]),
        (5, 6, [32, 16], &[5, 7, 9]),
        (70, 3, [64, 64], &[4]),
        (33, 3, [64, 64], &[16]),
        (130, 3, [64, 64], &[8, 16, 32, 32]),
        (3, 3, [128, 64], &[8, 40, 64]),
    ];
    for (batch, channels, [rows, columns], convolutions) in sizes {
        let stack = Stack::new(channels, [rows, columns], convolutions);
        let frames = normal(&mut random, &[batch, channels, rows, columns]);
        let frames: Arc<dyn Frames> = Arc::new(DenseFrames::new(&frames).unwrap());
        let len = stack.coarse_len();
        let (mut of_encoder, mut of_decoder) = (0, len);
        for sizes in stack.layers() {
            of_encoder += sizes.kernel_len() + sizes.coarse_channels;
            of_decoder += sizes.kernel_len() + sizes.fine_channels;
        }
        let small = |random: &mut Random, shape: &[usize], by: usize| {
            (normal(random, shape) / (by as f64).sqrt()).unwrap()
        };
        let name = |op: &str| format!("{op} {batch}x{channels}x{rows}x{columns} {convolutions:?}");
        let (outputs, hidden) = (31, small(&mut random, &[batch, 31], 1));
        let (packed, weight) =
            (small(&mut random, &[of_encoder], 40), small(&mut random, &[outputs, len], len));
        for dropout in [None, Some(Dropout::new(0.3, 11))] {
            let name = format!("{} dropout={}", name("frame encoder"), dropout.is_some());
            check(&name, &[packed.clone(), weight.clone()], BOUND, |x| {
                frame_encoder(frames.clone(), &stack, &x[0], &x[1], F32, dropout)
            });
        }
        let packed = small(&mut random, &[of_decoder], 40);
        let weight = small(&mut random, &[len, outputs], outputs);
        let layers = |x: &[Tensor]| FrameDecoder {
            stack: stack.clone(),
            weight: x[1].clone(),
            packed: x[2].clone(),
            arithmetic: F32,
        };
        let arguments = [hidden, weight, packed];
        check(&name("frame loss"), &arguments, BOUND, |x| frame_loss(&x[0], layers(x), frames.clone()));
        let decoded = |device: &Device| {
            let x = arguments.clone().map(|argument| argument.to_device(device).unwrap());
            frame_decoder(&x[0], &layers(&x)).unwrap()
        };
        compare(&name("frame decoder"), "result", &decoded(&gpu()), &decoded(&Device::Cpu), BOUND);
    }
}

#[test]
fn parts_stacks_and_averages_of_frames() {
    let mut random = random(8);
    let image = |random: &mut Random, batch: usize| -> Arc<dyn Frames> {
        Arc::new(DenseFrames::new(&normal(random, &[batch, 3, 32, 32])).unwrap())
    };
    let (first, second) = (image(&mut random, 12), image(&mut random, 12));
    let several: [(&str, Arc<dyn Frames>); 3] = [
        ("average", Averaged::over(first.clone(), 2)),
        ("part", part(&first, 4, 5)),
        ("stack", stacked(vec![first, second])),
    ];
    for (name, frames) in several {
        let stack = Stack::new(frames.channels(), frames.size(), &[4]);
        let sizes = &stack.layers()[0];
        let packed = normal(&mut random, &[sizes.kernel_len() + sizes.coarse_channels]);
        let weight = normal(&mut random, &[3, stack.coarse_len()]);
        check(&format!("frame encoder of a {name}"), &[packed, weight], BOUND, |x| {
            frame_encoder(frames.clone(), &stack, &x[0], &x[1], F32, None)
        });
    }
}

/// A kind of network: its name, its convolutions' channels, and the rest of its settings.
struct Kind {
    name: &'static str,
    channels: &'static [usize],
    hidden: &'static [usize],
    fusion: Fusion,
    memory: Memory,
    latent: usize,
    /// Sequences, and samples in each.
    batch: [usize; 2],
    dropout: f64,
}

const KINDS: [Kind; 6] = [
    Kind {
        name: "vectors",
        channels: &[],
        hidden: &[256, 256],
        fusion: Fusion::Early,
        memory: Memory::None,
        latent: 4,
        batch: [300, 1],
        dropout: 0.0,
    },
    Kind {
        name: "the paper's",
        channels: &[4],
        hidden: &[256, 256],
        fusion: Fusion::Early,
        memory: Memory::None,
        latent: 64,
        batch: [200, 1],
        dropout: 0.2,
    },
    Kind {
        name: "deep",
        channels: &[8, 16, 32, 32],
        hidden: &[256],
        fusion: Fusion::Late,
        memory: Memory::None,
        latent: 64,
        batch: [256, 1],
        dropout: 0.2,
    },
    Kind {
        name: "gru",
        channels: &[],
        hidden: &[256],
        fusion: Fusion::Early,
        memory: Memory::Gru,
        latent: 16,
        batch: [20, 25],
        dropout: 0.2,
    },
    Kind {
        name: "gru with images",
        channels: &[8, 16],
        hidden: &[128],
        fusion: Fusion::Late,
        memory: Memory::Gru,
        latent: 16,
        batch: [7, 6],
        dropout: 0.0,
    },
    Kind {
        name: "rssm",
        channels: &[],
        hidden: &[256],
        fusion: Fusion::Early,
        memory: Memory::Rssm,
        latent: 16,
        batch: [20, 25],
        dropout: 0.0,
    },
];

/// The losses of three steps of Adam, the gradients of the first one, and the parameters after them.
struct Steps {
    losses: Tensor,
    gradients: BTreeMap<String, Tensor>,
    parameters: BTreeMap<String, Tensor>,
}

impl Kind {
    fn images(&self) -> bool {
        !self.channels.is_empty()
    }

    fn known(&self, modalities: &[Modality]) -> Vec<Modality> {
        let is_known = |modality: &Modality| self.images() || !Layout::finger()[*modality].is_image();
        modalities.iter().copied().filter(is_known).collect()
    }

    fn architecture(&self, precision: Precision) -> Architecture {
        let layout = Layout::finger();
        Architecture {
            input: self.known(&[Modality::PROPRIOCEPTION, Modality::VISION]),
            output: self.known(&[
                Modality::PROPRIOCEPTION,
                Modality::CONTACT_FORCE,
                Modality::FRAME_DIFFERENCE,
            ]),
            latent: self.latent,
            action: layout.action().len(),
            layout,
            network: Network {
                preset: Preset::MultiToMulti,
                hidden: self.hidden.to_vec(),
                channels: Some(self.channels.to_vec()),
                fusion: self.fusion,
                memory: self.memory,
                ..Network::default()
            },
            arithmetic: arithmetic(precision),
            changes: BTreeMap::new(),
            hurdles: BTreeMap::new(),
            distributions: BTreeMap::new(),
        }
    }

    /// Trains the network for some epochs on random walks.
    fn fit(&self, data: &NormalizedData, partition: &Partition, window: &Window) -> (Vec<Epoch>, Parameters) {
        let architecture = self.architecture(Precision::F32);
        let training = Training {
            batch_size: 40,
            epochs: 5,
            patience: None,
            dropout: self.dropout,
            weight_decay: 0.05,
            ..Training::default()
        };
        let mut parameters = Parameters::new();
        let objective = Prediction {
            data,
            network: architecture.network(&mut parameters, &mut random(3), &data.device).unwrap(),
            window,
            input: &architecture.input,
            output: &architecture.output,
            training: &training,
            score: Score::Loss,
        };
        let fit = Fit {
            task: Task::Prediction,
            training: &training,
            seed: 3,
            partition,
            state: &StateFile::none(),
            progress: &Silent,
            log: &|_| (),
        };
        let epochs = fit.run(&objective, &parameters).unwrap();
        (epochs, parameters)
    }

    fn train(&self, device: &Device, precision: Precision) -> Result<Steps> {
        let (layout, frames, architecture) = (Layout::finger(), self.images(), self.architecture(precision));
        let [sequences, times] = self.batch;
        let batch = sequences * times;
        let mut random = random(0);
        let mut parameters = Parameters::new();
        let network = architecture.network(&mut parameters, &mut random, device)?;
        let mut adam = Adam::new(parameters.values().cloned().collect(), 1e-3)?
            .with_weight_decay(0.05)
            .with_clip_norm(Some(1.0));
        let mut matrix = |width: usize| normal(&mut random, &[batch, width]).to_device(device);
        let (seen, actions, next, force) =
            (matrix(20)?, matrix(layout.action().len())?, matrix(20)?, matrix(20)?);
        let vector = |modality, values| (modality, Value::Vector(values));
        let mut observed = vec![vector(Modality::PROPRIOCEPTION, seen)];
        let mut targets =
            vec![vector(Modality::PROPRIOCEPTION, next), vector(Modality::CONTACT_FORCE, force)];
        if frames {
            let mut image = || -> Result<Value> {
                Ok(Value::Frames(Arc::new(DenseFrames::new(&normal(&mut random, &[batch, 3, 64, 64]))?)))
            };
            observed.push((Modality::VISION, image()?));
            targets.push((Modality::FRAME_DIFFERENCE, image()?));
        }
        let (observed, targets): (Observation, Observation) =
            (observed.into_iter().collect(), targets.into_iter().collect());
        let (mut losses, mut first) = (Vec::new(), BTreeMap::new());
        for step in 0..3 {
            let draw = &mut Draw::Sample {
                random: &mut random,
                dropout: self.dropout,
                missing: &mut Random::new(0, Stream::Missing { epoch: 0 }),
            };
            let encoded = network.encode(&observed, draw)?;
            let start = network.start(sequences, device)?;
            let Seen { state, divergence, .. } =
                network.unroll(sequences, start.as_ref(), &encoded, &actions, draw)?;
            let mut loss = (divergence * 1e-2)?;
            let wanted = Targets {
                values: &targets,
                losses: &Default::default(),
                parts: 1,
                score: Score::Loss,
                added: None,
            };
            for term in network.losses(&state, wanted)? {
                loss = (loss + term.value.get(0)?)?;
            }
            let gradients = loss.backward()?;
            if step == 0 {
                for (name, parameter) in &parameters {
                    if let Some(gradient) = gradients.get(parameter) {
                        first.insert(name.clone(), gradient.copy()?);
                    }
                }
            }
            adam.step(&gradients)?;
            losses.push(loss.detach());
        }
        let parameters = parameters.iter().map(|(name, var)| Ok((name.clone(), var.as_tensor().copy()?)));
        Ok(Steps {
            losses: Tensor::stack(&losses, 0)?,
            gradients: first,
            parameters: parameters.collect::<Result<_>>()?,
        })
    }
}

#[test]
fn steps_of_every_network() {
    for kind in &KINDS {
        let expected = kind.train(&Device::Cpu, Precision::F32).unwrap();
        for (precision, bound) in [(Precision::F32, 1e-4), (Precision::Tf32, 5e-2)] {
            let found = kind.train(&gpu(), precision).unwrap();
            let name = format!("{} in {precision:?}", kind.name);
            compare(&name, "losses of three steps", &found.losses, &expected.losses, bound);
            assert_eq!(found.gradients.len(), expected.gradients.len(), "{name}: gradients");
            for (parameter, gradient) in &expected.gradients {
                compare(
                    &name,
                    &format!("gradient of {parameter}"),
                    &found.gradients[parameter],
                    gradient,
                    bound,
                );
            }
            for (parameter, value) in &expected.parameters {
                // Adam divides by the size of a gradient, so that the smallest gradients' rounding counts too.
                let what = format!("{parameter} after three steps");
                compare(&name, &what, &found.parameters[parameter], value, bound.sqrt());
            }
        }
    }
}

#[test]
fn the_same_steps_twice_are_equal_bit_for_bit() {
    for kind in &KINDS {
        let [first, second] = [(); 2].map(|()| kind.train(&gpu(), Precision::F32).unwrap());
        for (name, value) in &first.parameters {
            assert_eq!(values(value), values(&second.parameters[name]), "{}: {name}", kind.name);
        }
    }
}

#[test]
fn trainings_of_every_network() {
    let samples = Arc::new(walks::walks(8, 60));
    for kind in &KINDS {
        for horizon in [1, 3] {
            let has_memory = kind.memory != Memory::None;
            if horizon > 1 && !has_memory {
                continue;
            }
            let context = if has_memory { 7 } else { 1 };
            let window = Window { context, horizon, ..Window::TRANSITION };
            let partition = samples.partition(&Split::default(), &window).unwrap();
            let scalings = Modality::BUILT_IN
                .iter()
                .map(|&modality| (modality, World::paper(Scenario::EMPTY).scaling(modality, &[]).unwrap()))
                .collect();
            let normalizers = Normalizers::fit(&samples, &partition.training, &scalings, Action::Increment);
            let data =
                NormalizedData::new(samples.clone(), Arc::new(normalizers), Action::Increment, Device::Cpu);
            let (expected, _) = kind.fit(&data, &partition, &window);
            let [first, second] = [(); 2].map(|()| kind.fit(&data.on(gpu()), &partition, &window));
            let losses = |epochs: &[Epoch]| {
                let losses =
                    epochs.iter().flat_map(|epoch| epoch.train.values().chain(epoch.validation.values()));
                let losses: Vec<f32> = losses.map(|loss| *loss as f32).collect();
                Tensor::new(losses, &Device::Cpu).unwrap()
            };
            let name = format!("{}, horizon {horizon}", kind.name);
            // Adam amplifies the rounding of the smallest gradients, from step to step.
            for (what, epochs, bound) in [("the first epoch", 1, 1e-4), ("five epochs", 5, 2e-2)] {
                let what = format!("losses of {what}");
                compare(&name, &what, &losses(&first.0[..epochs]), &losses(&expected[..epochs]), bound);
            }
            for (parameter, value) in &first.1 {
                assert_eq!(
                    values(value),
                    values(&second.1[parameter]),
                    "{name}: {parameter} in two trainings"
                );
            }
        }
    }
}
