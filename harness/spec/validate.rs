//! What the schema cannot say: rules that tie several settings together.

use super::scaling::{Deviation, Scaling, Scalings};
use super::types::{
    Device, Division, Experiment, FRAME_SIDE, Modality, Network, Precision, STEP_RATE_HZ, Simulation, Split,
    Task, Training,
};

/// Largest tensor of a network, values: 1 GiB in single precision.
const MAX_TENSOR_LEN: usize = 1 << 28;
/// Most samples of one scenario; a frame is 12 KiB before compression.
const MAX_SAMPLES: usize = 100_000_000;

/// Most runs of one experiment.
const MAX_RUNS: usize = 10_000;

/// A broken rule.
#[derive(Debug)]
pub(super) struct Fault {
    /// Dotted path of the value at fault; a number is an index into a list.
    pub path: String,
    pub message: String,
}

fn fault(path: impl Into<String>, message: impl Into<String>) -> Result<(), Fault> {
    Err(Fault { path: path.into(), message: message.into() })
}

/// Refuses an experiment that cannot be run, or that would not mean what it says.
pub(super) fn validate(experiment: &Experiment) -> Result<(), Fault> {
    name(&experiment.name)?;
    runs(experiment)?;
    tasks(&experiment.tasks)?;
    frames(experiment)?;
    losses(experiment)?;
    precision(&experiment.training)?;
    steps(&experiment.training)?;
    ranges(&experiment.simulation)?;
    timing(&experiment.simulation)?;
    samples(&experiment.simulation)?;
    scaling(&experiment.scaling)?;
    split(experiment)
}

fn name(name: &str) -> Result<(), Fault> {
    let is_allowed = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    if (1..=64).contains(&name.len()) && name.chars().all(is_allowed) {
        return Ok(());
    }
    let name = super::parse::shorten(name);
    fault("name", format!("'{name}' can't name a folder; use 1 to 64 ASCII letters, digits, '_' and '-'"))
}

fn runs(experiment: &Experiment) -> Result<(), Fault> {
    let (scenarios, latent) = (experiment.scenarios.len(), experiment.latent.len());
    let seeds = experiment.seeds.len();
    let variants = experiment.vary.values().fold(1, |all: usize, values| all.saturating_mul(values.len()));
    let all = scenarios.saturating_mul(latent).saturating_mul(seeds).saturating_mul(variants);
    if all <= MAX_RUNS {
        return Ok(());
    }
    let path = if variants > seeds.max(latent) {
        "vary"
    } else if seeds > latent {
        "seeds"
    } else {
        "latent"
    };
    let varied = if variants > 1 { format!(", {variants} combinations of 'vary'") } else { String::new() };
    fault(
        path,
        format!(
            "{scenarios} scenarios, {latent} latent sizes{varied} and {seeds} seeds make {all} runs, more than the \
             {MAX_RUNS} that are allowed; divide them over several experiments"
        ),
    )
}

fn tasks(tasks: &[Task]) -> Result<(), Fault> {
    let position = |task| tasks.iter().position(|&other| other == task);
    let Some(reconstruction) = position(Task::Reconstruction) else { return Ok(()) };
    if position(Task::Prediction).is_some_and(|prediction| prediction < reconstruction) {
        return Ok(());
    }
    fault(
        format!("tasks.{reconstruction}"),
        "reconstruction uses the encoder that prediction trains; put prediction before it",
    )
}

fn frames(experiment: &Experiment) -> Result<(), Fault> {
    let lists = [("input", &experiment.input), ("output", &experiment.output)];
    let frame = lists.iter().find_map(|(list, modalities)| {
        let index = modalities.iter().position(|modality| modality.is_frame())?;
        Some((format!("{list}.{index}"), modalities[index]))
    });
    let Some((path, modality)) = frame else { return Ok(()) };
    let Network { preset, average, .. } = experiment.network;
    if experiment.network.channels().is_empty() {
        return fault(
            path,
            format!(
                "'{modality}' is a frame, and a {preset} network takes vectors alone; leave it out, use \
                 network.preset: multi_to_multi, or give it convolutions by network.channels"
            ),
        );
    }
    if !FRAME_SIDE.is_multiple_of(average) {
        return fault(
            "network.average",
            format!(
                "frames of {FRAME_SIDE} x {FRAME_SIDE} pixels have no whole squares of {average} x {average}"
            ),
        );
    }
    convolutions(&experiment.network)?;
    tensors(&experiment.network, &experiment.training)
}

/// Each convolution halves the side of its image, which must therefore be even.
fn convolutions(network: &Network) -> Result<(), Fault> {
    let side = FRAME_SIDE / network.average;
    let (most, asked) = (side.trailing_zeros() as usize, network.channels().len());
    if asked <= most {
        return Ok(());
    }
    let averaged = if network.average > 1 { " after averaging" } else { "" };
    fault(
        "network.channels",
        format!(
            "{asked} convolutions halve the side of a frame as often, and it has {side} pixels{averaged}; \
             give {most} channels at most"
        ),
    )
}

/// Bounds the largest tensors of the convolutions: the weights of the layer behind them, and a batch of what they make.
fn tensors(network: &Network, training: &Training) -> Result<(), Fault> {
    let convolutions = network.channels();
    let side = FRAME_SIDE >> convolutions.len();
    let values = convolutions.last().map_or(0, |channels| channels * side * side);
    let hidden = network.hidden.iter().copied().max().unwrap_or(1);
    for (path, factor) in [("network.hidden", hidden), ("training.batch_size", training.batch_size)] {
        if values * factor > MAX_TENSOR_LEN {
            let largest = MAX_TENSOR_LEN / values;
            return fault(
                path,
                format!(
                    "a tensor of the network would pass 1 GiB: with {values} values behind the convolutions, \
                     '{path}' can be {largest} at most, found {factor}"
                ),
            );
        }
    }
    Ok(())
}

fn precision(training: &Training) -> Result<(), Fault> {
    if (training.device, training.precision) == (Device::Cuda, Precision::Bf16) {
        return fault("training.precision", "bf16 is for the cpu; a network on cuda is trained in f32");
    }
    Ok(())
}

/// Refuses a warm-up that never ends, and a decay that would turn weights around.
fn steps(training: &Training) -> Result<(), Fault> {
    let Training { learning_rate, warmup_epochs, weight_decay, epochs, .. } = *training;
    if warmup_epochs > epochs as f64 {
        return fault(
            "training.warmup_epochs",
            format!("{warmup_epochs} epochs of warm-up don't fit into training.epochs, {epochs}; use fewer"),
        );
    }
    if learning_rate * weight_decay > 1.0 {
        return fault(
            "training.weight_decay",
            format!(
                "a step takes learning_rate times weight_decay of each weight away, here more than all of it; \
                 use {} at most",
                1.0 / learning_rate
            ),
        );
    }
    Ok(())
}

fn losses(experiment: &Experiment) -> Result<(), Fault> {
    let Training { losses, loss_weights: weights, .. } = &experiment.training;
    let named = weights.keys().map(|modality| ("loss_weights", "loss weight", modality));
    let mut named = named.chain(losses.keys().map(|modality| ("losses", "loss", modality)));
    if let Some((key, words, modality)) = named.find(|(.., modality)| !experiment.output.contains(modality)) {
        return fault(
            format!("training.{key}.{modality}"),
            format!("'{modality}' has a {words} but is no output; outputs: {}", list(&experiment.output)),
        );
    }
    let weight = |modality| weights.get(modality).copied().unwrap_or(1.0);
    if experiment.output.iter().all(|modality| weight(modality) == 0.0) {
        return fault("training.loss_weights", "every output has weight 0, so there is nothing to learn");
    }
    Ok(())
}

fn list(modalities: &[Modality]) -> String {
    modalities.iter().map(|modality| modality.name()).collect::<Vec<_>>().join(", ")
}

fn ranges(simulation: &Simulation) -> Result<(), Fault> {
    let ranges = [
        ("rotation_range_rad", simulation.rotation_range_rad),
        ("lift_range_m", simulation.lift_range_m),
        ("extension_range_m", simulation.extension_range_m),
    ];
    for (key, [low, high]) in ranges {
        if low > high {
            return fault(
                format!("simulation.{key}"),
                format!("the range [{low}, {high}] is reversed; write [{high}, {low}]"),
            );
        }
    }
    Ok(())
}

fn timing(simulation: &Simulation) -> Result<(), Fault> {
    let Simulation { actuation_seconds: seconds, sample_rate_hz: rate, .. } = *simulation;
    if !is_positive_whole(STEP_RATE_HZ / rate) {
        return fault(
            "simulation.sample_rate_hz",
            format!(
                "{rate} Hz does not divide the simulation's {STEP_RATE_HZ} Hz; use one that does, \
                     as 10, 20, 50 or 100"
            ),
        );
    }
    if !is_positive_whole(seconds * rate) {
        let interval = 1.0 / rate;
        return fault(
            "simulation.actuation_seconds",
            format!(
                "{seconds} s is not a whole number of samples at {rate} Hz; use a multiple of {interval} s"
            ),
        );
    }
    Ok(())
}

fn is_positive_whole(value: f64) -> bool {
    value.round() >= 1.0 && (value - value.round()).abs() < 1e-9 * value
}

fn samples(simulation: &Simulation) -> Result<(), Fault> {
    let an_episode = simulation.samples_per_episode();
    if an_episode < 2 {
        return fault(
            "simulation.actuations_per_episode",
            "an episode of one sample has no next observation to predict; use at least 2 samples",
        );
    }
    let all = an_episode * simulation.episodes as usize;
    if all > MAX_SAMPLES {
        return fault(
            "simulation.episodes",
            format!(
                "{all} samples a scenario are more than the {MAX_SAMPLES} that are allowed; \
                     use fewer or shorter episodes"
            ),
        );
    }
    Ok(())
}

fn scaling(scalings: &Scalings) -> Result<(), Fault> {
    let per_element = |(modality, scaling): &(&Modality, &Scaling)| {
        modality.is_frame() && scaling.scale == Deviation::PerElement
    };
    let Some((modality, _)) = scalings.iter().find(per_element) else { return Ok(()) };
    fault(
        format!("scaling.{modality}.scale"),
        format!("'{modality}' is a frame, whose values have one deviation for all; use shared"),
    )
}

fn split(experiment: &Experiment) -> Result<(), Fault> {
    let Experiment { split, simulation, .. } = experiment;
    let (by, validation, test) = (split.by, split.validation, split.test);
    if split.gap_seconds.is_some() && by != Division::Time {
        return fault(
            "split.gap_seconds",
            format!("a split by {by} has no gap; leave it out, or use split.by: time"),
        );
    }
    let (episodes, samples) = (simulation.episodes as usize, simulation.samples_per_episode());
    match by {
        Division::Episode if episodes < 3 => fault(
            "simulation.episodes",
            format!(
                "a split by episode needs at least 3 episodes, one each for training, validation and test, found \
                 {episodes}; use more, or split.by: time, which divides each episode"
            ),
        ),
        Division::Episode if split.counts(episodes).is_none() => fault(
            "split",
            format!(
                "validation {validation} and test {test} of {episodes} episodes leave none for training; \
                 use smaller shares or more episodes"
            ),
        ),
        Division::Time if split.times(samples, simulation.sample_rate_hz).is_none() => fault(
            "split",
            format!(
                "validation {validation}, test {test} and two gaps of {} s leave nothing of an episode of {} s for \
                 training; use smaller shares, a smaller gap_seconds or more actuations_per_episode",
                split.gap_seconds.unwrap_or(Split::GAP_SECONDS),
                samples as f64 / simulation.sample_rate_hz,
            ),
        ),
        Division::Sample if split.counts(episodes * (samples - 1)).is_none() => fault(
            "split",
            format!(
                "validation {validation} and test {test} of {} transitions leave none for training; use smaller \
                 shares or more samples",
                episodes * (samples - 1)
            ),
        ),
        _ => Ok(()),
    }
}
