//! Times one training step of a network on random data. training_step.py does the same in PyTorch.
//!
//!     cargo run --release --example training_step -- --channels 16 --latent 64 --steps 20
//!     cargo run --release --example training_step -- --channels 8 16 32 32 --fusion late --hidden 256
//!     cargo run --release --example training_step -- --latent 4
//!     cargo run --release --example training_step -- --memory gru --context 50 --batch 1000
//!
//! The commands time the paper's network, a deep network, a network for vectors, and a recurrent one on 20 sequences.
//! Each prints one line of JSON with the median, the least and the greatest number of seconds per step.

use candle_core::{Device, Tensor};
use clap::Parser;
use harness::learning::network::{Architecture, Draw, Observation, Parameters, Score, Seen, Targets, Value};
use harness::learning::random::{Random, Stream};
use harness::ops::Adam;
use harness::ops::arithmetic;
use harness::ops::frames::{DenseFrames, Frames};
use harness::spec::{Fusion, Layout, Memory, Modality, Network, Precision, Preset, Task};
use std::sync::Arc;
use std::time::Instant;

/// The allocator that the harness itself uses, see main.rs.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

#[derive(Parser)]
struct Arguments {
    /// Output channels of each convolution; without any, the network is for vectors alone.
    #[arg(long, num_args = 0..)]
    channels: Vec<usize>,
    /// early or late
    #[arg(long, default_value = "early", value_parser = fusion)]
    fusion: Fusion,
    /// Width of each hidden layer.
    #[arg(long, num_args = 1.., default_values_t = [256])]
    hidden: Vec<usize>,
    /// Size of the latent state.
    #[arg(long, default_value_t = 64)]
    latent: usize,
    /// none, window, gru or rssm
    #[arg(long, default_value = "none", value_parser = memory)]
    memory: Memory,
    /// Number of samples in a sequence, which a network with memory sees one after the other.
    #[arg(long, default_value_t = 1)]
    context: usize,
    /// Number of samples in a step: those of whole sequences.
    #[arg(long, default_value_t = 1024)]
    batch: usize,
    /// Number of timed steps.
    #[arg(long, default_value_t = 20)]
    steps: usize,
    /// cpu or cuda
    #[arg(long, default_value = "cpu", value_parser = device)]
    device: harness::spec::Device,
    /// Number of steps that are timed together. A GPU computes one step while the next ones are queued.
    #[arg(long, default_value_t = 1)]
    block: usize,
    /// f32 or bf16, and tf32 on a GPU
    #[arg(long, default_value = "f32", value_parser = precision)]
    precision: Precision,
    /// Do not use the processor's tile unit.
    #[arg(long)]
    no_tiles: bool,
}

fn fusion(name: &str) -> Result<Fusion, String> {
    let found = Fusion::ALL.iter().copied().find(|fusion| fusion.name() == name);
    found.ok_or_else(|| format!("'{name}' is neither early nor late"))
}

fn memory(name: &str) -> Result<Memory, String> {
    let found = Memory::ALL.iter().copied().find(|memory| memory.name() == name);
    found.ok_or_else(|| format!("'{name}' is neither none, window, gru nor rssm"))
}

fn device(name: &str) -> Result<harness::spec::Device, String> {
    let found = harness::spec::Device::ALL.iter().copied().find(|device| device.name() == name);
    found.ok_or_else(|| format!("'{name}' is neither cpu nor cuda"))
}

fn precision(name: &str) -> Result<Precision, String> {
    let found = Precision::ALL.iter().copied().find(|precision| precision.name() == name);
    found.ok_or_else(|| format!("'{name}' is neither f32, bf16 nor tf32"))
}

type Step<'a> = dyn FnMut(&mut Random, &mut Adam) -> candle_core::Result<Tensor> + 'a;

/// Returns the step itself, or on a GPU the same step recorded as a graph, as trainings repeat it.
fn repeated<'a>(
    device: &Device,
    step: &'a mut Step,
    random: &mut Random,
    adam: &mut Adam,
) -> candle_core::Result<Box<Step<'a>>> {
    #[cfg(feature = "cuda")]
    if device.is_cuda() {
        use harness::ops::Values;
        use harness::ops::graph::{Graph, first_run};
        let (losses, inputs) = first_run(device, || step(random, adam))?;
        let lens: Vec<usize> = inputs.iter().map(|input| input.values.len()).collect();
        let of_adam = adam.input().len();
        let graph = Graph::record(device, inputs, losses.copy()?, || step(random, adam))?;
        return Ok(Box::new(move |random, adam| {
            let adam = adam.count();
            let value = |len: &usize| match *len {
                len if len == of_adam => adam.clone(),
                len => Values::F32(random.normal(len)),
            };
            graph.repeat(&lens.iter().map(value).collect::<Vec<_>>())
        }));
    }
    let _ = (device, random, adam);
    Ok(Box::new(step))
}

fn main() -> anyhow::Result<()> {
    // SAFETY: no other thread exists yet. Option 15 is the purge delay, a number that may be set at any time.
    unsafe {
        harness::learning::prepare_threads();
        libmimalloc_sys::mi_option_set(15, -1);
    }
    let arguments = Arguments::parse();
    let frames = !arguments.channels.is_empty();
    let layout = Layout::finger();
    let only = |modalities: &[Modality]| -> Vec<Modality> {
        modalities.iter().copied().filter(|modality| frames || !layout[*modality].is_image()).collect()
    };
    let architecture = Architecture {
        input: only(&[Modality::PROPRIOCEPTION, Modality::VISION]),
        output: only(&[Modality::PROPRIOCEPTION, Modality::CONTACT_FORCE, Modality::FRAME_DIFFERENCE]),
        latent: arguments.latent,
        layout: layout.clone(),
        action: layout.action().len(),
        network: Network {
            preset: Preset::MultiToMulti,
            hidden: arguments.hidden.clone(),
            channels: Some(arguments.channels.clone()),
            fusion: arguments.fusion,
            memory: arguments.memory,
            ..Network::default()
        },
        arithmetic: arithmetic(!arguments.no_tiles, arguments.precision),
        changes: Default::default(),
        hurdles: Default::default(),
        distributions: Default::default(),
    };
    let batch = arguments.batch;
    if !batch.is_multiple_of(arguments.context) {
        anyhow::bail!("{batch} samples are no whole sequences of {}", arguments.context);
    }
    let sequences = batch / arguments.context;
    let device = harness::learning::open_device(arguments.device)?;
    let mut random = Random::new(0, Stream::Parameters(Task::Prediction));
    let mut parameters = Parameters::new();
    let network = architecture.network(&mut parameters, &mut random, &device)?;
    let mut adam = Adam::new(parameters.values().cloned().collect(), 1e-3)?;
    let mut matrix = |width: usize| Tensor::from_vec(random.normal(batch * width), (batch, width), &device);
    let (vector_seen, actions, target) = (matrix(20)?, matrix(layout.action().len())?, matrix(40)?);
    let mut picture = || -> candle_core::Result<Arc<dyn Frames>> {
        let values = random.normal(batch * 3 * 64 * 64);
        Ok(Arc::new(DenseFrames::new(&Tensor::from_vec(values, (batch, 3, 64, 64), &Device::Cpu)?)?))
    };
    let mut image = |modality| Ok::<_, candle_core::Error>((modality, Value::Frames(picture()?)));
    let seen = frames.then(|| image(Modality::VISION)).transpose()?;
    let changed = frames.then(|| image(Modality::FRAME_DIFFERENCE)).transpose()?;
    let vector = |modality, values| (modality, Value::Vector(values));
    let observation: Observation =
        seen.into_iter().chain([vector(Modality::PROPRIOCEPTION, vector_seen)]).collect();
    let vectors = [
        vector(Modality::PROPRIOCEPTION, target.narrow(1, 0, 20)?.contiguous()?),
        vector(Modality::CONTACT_FORCE, target.narrow(1, 20, 20)?.contiguous()?),
    ];
    let values: Observation = changed.into_iter().chain(vectors).collect();
    let targets =
        Targets { values: &values, losses: &Default::default(), parts: 1, score: Score::Loss, added: None };
    let mut step = |random: &mut Random, adam: &mut Adam| -> candle_core::Result<Tensor> {
        let draw = &mut Draw::Sample {
            random,
            dropout: 0.0,
            missing: &mut Random::new(0, Stream::Missing { epoch: 0 }),
        };
        let encoded = network.encode(&observation, draw)?;
        let start = network.start(sequences, &device)?;
        let Seen { state, divergence, .. } =
            network.unroll(sequences, start.as_ref(), &encoded, &actions, draw)?;
        let mut loss = (divergence * 1e-3)?;
        for term in network.losses(&state, targets)? {
            loss = (loss + term.value.get(0)?)?;
        }
        adam.step(&loss.backward()?)?;
        loss.detach().reshape(1)
    };
    let mut repeated = repeated(&device, &mut step, &mut random, &mut adam)?;
    let mut seconds = Vec::with_capacity(arguments.steps);
    for _ in 0..arguments.steps.div_ceil(arguments.block) + 2 {
        let begin = Instant::now();
        for _ in 0..arguments.block {
            repeated(&mut random, &mut adam)?;
        }
        device.synchronize()?;
        seconds.push(begin.elapsed().as_secs_f64() / arguments.block as f64);
    }
    // The first two blocks warm up caches, the allocator and a GPU.
    let mut seconds = seconds.split_off(2);
    seconds.sort_by(f64::total_cmp);
    println!(
        "{}",
        serde_json::json!({
            "channels": arguments.channels, "fusion": arguments.fusion.name(), "hidden": arguments.hidden,
            "latent": arguments.latent, "memory": arguments.memory.name(), "context": arguments.context,
            "batch": batch, "device": arguments.device.name(), "precision": arguments.precision.name(),
            "unit": format!("{:?}", architecture.arithmetic.unit),
            "median_seconds": seconds[seconds.len() / 2], "min": seconds[0], "max": seconds[seconds.len() - 1],
            "threads": rayon::current_num_threads(),
        })
    );
    Ok(())
}
