//! Checks the rules that the schema can't express, because they depend on several settings.

mod search;
mod split;

use super::disturbance::{Disturbances, unsuitable};
use super::origin::Origin;
use super::schema::is_axis;
use super::simulation::{Setting, Simulation};
use super::split::Division;
use super::types::{
    Device, Experiment, Family, Fusion, Given, Loss, Memory, ModalityDropout, Network, Precision, Predict,
    Preset, Reading, Task, Together, Training, WindowStart,
};
use super::vary::VARY;
use super::world::World;
use crate::layout::{Modality, Scale};
use crate::yaml::{is_name, shorten, unknown};
use serde_json::{Map, Value as Json};
use std::collections::BTreeSet;

/// Largest number of values in a tensor of a network: 1 GiB in single precision.
const MAX_TENSOR_LEN: usize = 1 << 28;
/// Largest number of samples in one scenario.
const MAX_SAMPLES: usize = 100_000_000;

/// Largest number of runs in one experiment.
const MAX_RUNS: usize = 10_000;

/// A broken rule.
#[derive(Debug)]
pub(super) struct Fault {
    /// Dotted path of the value at fault; a number is an index into a list.
    pub path: String,
    pub message: String,
}

impl Fault {
    /// Creates the fault of a setting that the spec leaves out, and for which two worlds have different defaults. The
    /// other world was named at `path`.
    pub fn between_worlds(key: &str, one: &World, other: &World, path: &str) -> Self {
        let (one, other) = (one.scenario(), other.scenario());
        let message = format!(
            "the worlds {one} and {other} have different defaults for 'simulation.{key}'; give it a value"
        );
        Self { path: path.to_owned(), message }
    }
}

fn fault(path: impl Into<String>, message: impl Into<String>) -> Result<(), Fault> {
    Err(Fault { path: path.into(), message: message.into() })
}

/// Refuses an experiment that can't be run, or whose settings contradict each other.
pub(super) fn validate(experiment: &Experiment) -> Result<(), Fault> {
    name(&experiment.name)?;
    readings(experiment)?;
    axes(experiment)?;
    runs(experiment)?;
    scenarios(experiment)?;
    modalities(experiment)?;
    tasks(&experiment.tasks)?;
    given(experiment)?;
    probes(experiment)?;
    outputs(experiment)?;
    precision(&experiment.training)?;
    steps(&experiment.training)?;
    settings(experiment)?;
    samples(&experiment.simulation)?;
    scaling(experiment)?;
    window(experiment)?;
    split::validate(experiment)?;
    search::validate(experiment)
}

/// Refuses an experiment whose data a network can't take, or whose window it can't predict.
pub(super) fn validate_network(experiment: &Experiment) -> Result<(), Fault> {
    frames(experiment)?;
    memory(experiment)
}

fn name(name: &str) -> Result<(), Fault> {
    let is_allowed = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    if (1..=64).contains(&name.len()) && name.chars().all(is_allowed) {
        return Ok(());
    }
    let name = shorten(name);
    fault("name", format!("'{name}' can't name a folder; use 1 to 64 ASCII letters, digits, '_' and '-'"))
}

/// Refuses names of readings that are invalid or not unique.
fn readings(experiment: &Experiment) -> Result<(), Fault> {
    for (index, Reading { name, .. }) in experiment.readings.iter().enumerate() {
        let path = format!("readings.{index}.name");
        if name == Reading::BASE {
            return fault(
                path,
                "'base' is the name of the reading with the spec's own settings; use another name",
            );
        }
        if !is_name(name) {
            return fault(path, NAME_RULE.replace("{}", &shorten(name)));
        }
        if experiment.readings[..index].iter().any(|other| other.name == *name) {
            return fault(path, format!("there is a reading '{name}' already"));
        }
    }
    Ok(())
}

/// Refuses names of axes that also mean something else.
fn axes(experiment: &Experiment) -> Result<(), Fault> {
    let labeled = experiment.vary.iter().filter(|(_, axis)| axis.is_object());
    for (name, _) in labeled {
        let is_taken = name == "reading" && !experiment.readings.is_empty();
        if is_taken || !is_axis(name) {
            return fault(
                format!("{VARY}.{name}"),
                format!(
                    "'{name}' can't name an axis with labels, because it has another meaning; use another name"
                ),
            );
        }
    }
    Ok(())
}

/// Message for an invalid name in the column `variant`.
const NAME_RULE: &str =
    "'{}' can't name a reading; use 1 to 64 lower-case letters, digits and '_', a letter first";

fn runs(experiment: &Experiment) -> Result<(), Fault> {
    let (scenarios, latent) = (experiment.scenarios.len(), experiment.latent.len());
    let seeds = experiment.seeds.len();
    let product = |all: usize, count: usize| all.saturating_mul(count);
    let readings = if experiment.readings.is_empty() { 1 } else { experiment.readings.len() + 1 };
    let points = |axis: &Json| axis.as_array().map_or_else(|| axis.as_object().map_or(1, Map::len), Vec::len);
    let varied = experiment.vary.values().map(points).fold(readings, product);
    let trials = experiment.search.as_ref().map_or(1, |search| search.trials);
    let variants = varied.saturating_mul(trials);
    let all = scenarios.saturating_mul(latent).saturating_mul(seeds).saturating_mul(variants);
    if all <= MAX_RUNS {
        return Ok(());
    }
    let path = if trials > varied.max(seeds).max(latent) {
        "search.trials"
    } else if variants > seeds.max(latent) {
        "vary"
    } else if seeds > latent {
        "seeds"
    } else {
        "latent"
    };
    let varied = match variants {
        1 => String::new(),
        _ => format!(", {variants} combinations of settings"),
    };
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

/// Refuses a scenario that is not the name of a built-in world.
fn scenarios(experiment: &Experiment) -> Result<(), Fault> {
    for (index, origin) in experiment.scenarios.iter().enumerate() {
        if let Some(message) = unknown_world(origin, "scenario", "scenarios") {
            return fault(
                format!("scenarios.{index}"),
                message + ", the path of a world file, or the name of an imported dataset",
            );
        }
    }
    Ok(())
}

/// The message about a name of no built-in world, which is a `kind` of thing in the setting `key`.
fn unknown_world(origin: &Origin, kind: &str, key: &str) -> Option<String> {
    let Origin::Simulated(scenario) = origin else { return None };
    let names: Vec<&str> = World::built_in().iter().map(|world| world.scenario().name()).collect();
    let is_known = names.contains(&scenario.name());
    (!is_known).then(|| unknown(kind, scenario.name(), key, &names, str::to_owned))
}

/// Refuses a modality that one of the worlds does not declare. The modalities of an imported dataset are checked when
/// it is opened.
fn modalities(experiment: &Experiment) -> Result<(), Fault> {
    let Experiment { input, output, probes, .. } = experiment;
    let lists = [("input", input), ("output", output), ("probes", probes)];
    let worlds: Vec<_> = experiment.scenarios.iter().filter_map(|origin| experiment.world(origin)).collect();
    for world in &worlds {
        let names: Vec<&str> = world.modalities().map(Modality::name).collect();
        for (list, modalities) in lists {
            let missing = modalities.iter().position(|modality| !names.contains(&modality.name()));
            if let Some(index) = missing {
                let mut message = unknown("modality", modalities[index].name(), list, &names, str::to_owned);
                let elsewhere =
                    |other: &&std::sync::Arc<World>| other.modalities().any(|name| name == modalities[index]);
                if worlds.iter().any(|other| elsewhere(&other)) {
                    message += &format!(" in the world {}", world.scenario());
                }
                return fault(format!("{list}.{index}"), message);
            }
        }
    }
    Ok(())
}

/// Refuses a test with, or a training without, what is no input.
fn given(experiment: &Experiment) -> Result<(), Fault> {
    let Experiment { given, input, inputs, training, .. } = experiment;
    let names: Vec<&str> = input.iter().map(|modality| modality.name()).collect();
    let has_input = |axis: &Json| {
        axis.as_object().is_some_and(|labels| labels.values().any(|one| one.get("input").is_some()))
    };
    let is_varied = experiment.vary.iter().any(|(key, axis)| key == "input" || has_input(axis));
    let remedy = |key: &str| match is_varied {
        true => {
            format!(
                "; 'vary' changes the input, so give {key} to the labels of an axis, each with its own input"
            )
        }
        false => String::new(),
    };
    let no_input = |path: String, modality: &Modality| {
        let key = if path.starts_with("given") { "given" } else { "training.modality_dropout" };
        fault(path, unknown("input", modality.name(), "", &names, str::to_owned) + &remedy(key))
    };
    disturbances("inputs", experiment, inputs)?;
    for (index, given) in given.iter().enumerate() {
        match given {
            Given::Named(_) => {}
            Given::Inputs(inputs) => {
                if let Some(place) = inputs.iter().position(|modality| !input.contains(modality)) {
                    return no_input(format!("given.{index}.{place}"), &inputs[place]);
                }
            }
            Given::Disturbed(inputs) if inputs.is_empty() => {
                return fault(format!("given.{index}"), "a network needs an input; name at least one");
            }
            Given::Disturbed(inputs) => disturbances(&format!("given.{index}"), experiment, inputs)?,
        }
    }
    let path = "training.modality_dropout";
    match &training.modality_dropout {
        ModalityDropout::Every(_) => {}
        ModalityDropout::Of(rates) => {
            if let Some(modality) = rates.keys().find(|modality| !input.contains(modality)) {
                return no_input(format!("{path}.{modality}"), modality);
            }
        }
        ModalityDropout::Together(all) => {
            for (index, Together { inputs, .. }) in all.iter().enumerate() {
                let lacking = inputs.iter().position(|modality| !input.contains(modality));
                if let Some(place) = lacking {
                    return no_input(format!("{path}.{index}.inputs.{place}"), &inputs[place]);
                }
                if inputs.is_empty() || input.iter().all(|modality| inputs.contains(modality)) {
                    let problem =
                        "name at least one input, and not all of them, because a network needs an input";
                    return fault(format!("{path}.{index}.inputs"), problem.to_owned() + &remedy(path));
                }
            }
            // 0.7 + 0.2 + 0.1 is a little less than 1.
            if all.iter().map(|one| one.probability).sum::<f64>() > 1.0 - 1e-9 {
                return fault(
                    path,
                    "the probabilities are 1 or more together; a window lacks one item at most",
                );
            }
        }
    }
    Ok(())
}

/// Refuses probes without the decoder that estimates them.
fn probes(experiment: &Experiment) -> Result<(), Fault> {
    match experiment.probes.is_empty() || experiment.tasks.contains(&Task::Reconstruction) {
        true => Ok(()),
        false => fault("probes", "the reconstruction estimates them; add reconstruction to 'tasks'"),
    }
}

/// Refuses a disturbance of what is no input, or one that an image or a vector can't have.
fn disturbances(path: &str, experiment: &Experiment, inputs: &Disturbances) -> Result<(), Fault> {
    let Experiment { input, scenarios, .. } = experiment;
    for (modality, disturbance) in inputs {
        if !input.contains(modality) {
            let names: Vec<&str> = input.iter().map(|modality| modality.name()).collect();
            let message = unknown("input", modality.name(), "", &names, str::to_owned);
            return fault(format!("{path}.{modality}"), format!("{message}; only inputs are disturbed"));
        }
        let known = scenarios.iter().filter_map(|origin| experiment.known(origin, *modality));
        for is_image in known.map(|known| known.size.is_some()) {
            if let Some(key) = disturbance.unsuitable(is_image) {
                return fault(format!("{path}.{modality}.{key}"), unsuitable(*modality, key, is_image));
            }
        }
    }
    Ok(())
}

/// The images among the inputs and outputs of a network, with their rows and columns.
pub(super) struct Images<'a> {
    pub input: &'a [(Modality, [usize; 2])],
    pub output: &'a [(Modality, [usize; 2])],
}

fn frames(experiment: &Experiment) -> Result<(), Fault> {
    for origin in &experiment.scenarios {
        let images = |modalities: &[Modality]| -> Vec<(Modality, [usize; 2])> {
            let size = |modality: &Modality| Some((*modality, experiment.known(origin, *modality)?.size?));
            modalities.iter().filter_map(size).collect()
        };
        let (input, output) = (images(&experiment.input), images(&experiment.output));
        let images = Images { input: &input, output: &output };
        // The image sizes of an imported dataset are not known before it is opened.
        let checked = match experiment.world(origin) {
            Some(_) => check_images(&images, &experiment.network, &experiment.training),
            None => convolves(&images, &experiment.network),
        };
        checked.map_err(|fault| place(fault, experiment))?;
    }
    Ok(())
}

/// Replaces the modality in the path of a fault by its place in the spec.
fn place(fault: Fault, experiment: &Experiment) -> Fault {
    let at = |list: &str, modalities: &[Modality]| {
        let index = modalities.iter().position(|modality| modality.name() == fault.path)?;
        Some(format!("{list}.{index}"))
    };
    let path = at("input", &experiment.input).or_else(|| at("output", &experiment.output));
    Fault { path: path.unwrap_or(fault.path), message: fault.message }
}

/// Refuses images if the network has no convolutions. The fault's path is the modality.
fn convolves(images: &Images, network: &Network) -> Result<(), Fault> {
    let Some((modality, _)) = images.input.iter().chain(images.output).next() else { return Ok(()) };
    if !network.channels().is_empty() {
        return Ok(());
    }
    let (kind, remedy) = match network.preset {
        Preset::SingleToMulti => ("a single_to_multi network", ", use network.preset: multi_to_multi"),
        Preset::MultiToMulti => ("a network without channels", ""),
    };
    fault(
        modality.name(),
        format!(
            "'{modality}' is an image, and {kind} takes vectors alone; leave it out{remedy}, or give it convolutions \
             by network.channels"
        ),
    )
}

/// Refuses images that the network can't process.
pub(super) fn check_images(images: &Images, network: &Network, training: &Training) -> Result<(), Fault> {
    convolves(images, network)?;
    for (list, averaged) in [(images.input, true), (images.output, false)] {
        let Some(&(first, [rows, columns])) = list.first() else { continue };
        if let Some((other, [rows, columns])) = list.iter().find(|(_, size)| *size != [rows, columns]) {
            return fault(
                other.name(),
                format!(
                    "'{other}' has {rows} x {columns} pixels and '{first}' {} x {}; images that go into a network, or \
                     come out of it, together must have one size",
                    list[0].1[0], list[0].1[1]
                ),
            );
        }
        convolutions(first, [rows, columns], network, averaged)?;
        tensors([rows, columns], network, training)?;
    }
    Ok(())
}

/// Refuses an image whose sides can't be halved by each convolution. An input is averaged before the convolutions.
fn convolutions(
    modality: Modality,
    size: [usize; 2],
    network: &Network,
    averaged: bool,
) -> Result<(), Fault> {
    let average = if averaged { network.average } else { 1 };
    if size.iter().any(|side| !side.is_multiple_of(average)) {
        let [rows, columns] = size;
        return fault(
            "network.average",
            format!(
                "images of {rows} x {columns} pixels can't be divided into squares of {average} x {average}"
            ),
        );
    }
    // The side that can be halved fewer times.
    let [rows, columns] = size.map(|side| side / average);
    let side = if columns.trailing_zeros() < rows.trailing_zeros() { columns } else { rows };
    let (most, asked) = (side.trailing_zeros() as usize, network.channels().len());
    if asked <= most {
        return Ok(());
    }
    let words = if average > 1 { " after averaging" } else { "" };
    if most == 0 {
        return fault(
            modality.name(),
            format!(
                "'{modality}' has a side of {side} pixels{words}, which is odd; a convolution halves it, so use an \
                 even number"
            ),
        );
    }
    fault(
        "network.channels",
        format!(
            "{asked} convolutions halve the side of an image as often, and it has {side} pixels{words}; \
             give {most} channels at most"
        ),
    )
}

/// Limits the size of the largest tensors: the weights of the layer after the convolutions, and a batch of its inputs.
fn tensors([rows, columns]: [usize; 2], network: &Network, training: &Training) -> Result<(), Fault> {
    let convolutions = network.channels();
    let [rows, columns] = [rows, columns].map(|side| side >> convolutions.len());
    let values = convolutions.last().map_or(0, |channels| channels * rows * columns);
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
    match (training.device, training.precision) {
        (Device::Cuda, Precision::Bf16) => {
            fault("training.precision", "bf16 is for the cpu; a network on cuda is trained in f32 or tf32")
        }
        (Device::Cpu, Precision::Tf32) => {
            fault("training.precision", "tf32 is for cuda; a network on the cpu is trained in f32 or bf16")
        }
        _ => Ok(()),
    }
}

/// Refuses a warm-up that is longer than the training, and a weight decay that would change the sign of weights.
fn steps(training: &Training) -> Result<(), Fault> {
    let Training { learning_rate, warmup_epochs, weight_decay, epochs, last_epoch, .. } = *training;
    if let Some(last) = last_epoch.filter(|last| *last >= epochs) {
        return fault(
            "training.last_epoch",
            format!(
                "the training ends after epoch {epochs} (training.epochs) anyway; use less than {last}, or leave it out"
            ),
        );
    }
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

/// Checks the settings of outputs.
fn outputs(experiment: &Experiment) -> Result<(), Fault> {
    let Experiment { input, output, outputs, training, .. } = experiment;
    let Training { predict, losses, distributions, loss_weights: weights, .. } = training;
    // Where a setting was written.
    let path = |key: &str, stored: &str, modality: &Modality| match outputs.contains_key(modality) {
        true => format!("outputs.{modality}.{key}"),
        false => format!("training.{stored}.{modality}"),
    };
    let named = weights.keys().map(|modality| (path("weight", "loss_weights", modality), modality));
    let named = named.chain(losses.keys().map(|modality| (path("loss", "losses", modality), modality)));
    let named = named.chain(predict.keys().map(|modality| (path("predict", "predict", modality), modality)));
    let named = named.chain(
        distributions.keys().map(|modality| (path("distribution", "distributions", modality), modality)),
    );
    let empty = outputs.keys().map(|modality| (format!("outputs.{modality}"), modality));
    if let Some((path, modality)) = named.chain(empty).find(|(_, modality)| !output.contains(modality)) {
        return fault(path, format!("'{modality}' is not an output; outputs: {}", list(output)));
    }
    let is_image = |modality: &Modality| {
        let known = experiment.scenarios.iter().find_map(|origin| experiment.known(origin, *modality));
        known.is_some_and(|known| known.size.is_some())
    };
    if let Some(modality) = losses.keys().find(|modality| is_image(modality)) {
        return fault(
            path("loss", "losses", modality),
            format!("'{modality}' is an image, whose errors are squared; leave it out"),
        );
    }
    let distributed = || distributions.iter().filter(|(_, family)| **family != Family::None);
    if let Some((modality, _)) = distributed().find(|(modality, _)| is_image(modality)) {
        return fault(
            path("distribution", "distributions", modality),
            format!("'{modality}' is an image, of which no distribution can be predicted; leave it out"),
        );
    }
    let has_loss = |modality: &Modality| losses.get(modality).is_some_and(|loss| *loss != Loss::Squared);
    if let Some((modality, family)) = distributed().find(|(modality, _)| has_loss(modality)) {
        return fault(
            path("loss", "losses", modality),
            format!(
                "the loss of '{modality}' is the score of its distribution ({family}); leave out one of them"
            ),
        );
    }
    for (modality, _) in distributed().filter(|(_, family)| **family == Family::Hurdle) {
        let given = experiment.scaling.get(modality).copied().unwrap_or_default();
        let known = experiment.scenarios.iter().filter_map(|origin| experiment.known(origin, *modality));
        let problem = if known.map(|known| given.or(known.scaling).minimum).any(|least| least != Some(0.0)) {
            format!(
                "is not bounded by 0, as a hurdle is; set scaling.{modality}.minimum to 0, or use gaussian"
            )
        } else if predict.get(modality) == Some(&Predict::Change) {
            "is predicted as a change, but a hurdle is the distribution of a value; use gaussian".to_owned()
        } else {
            continue;
        };
        return fault(path("distribution", "distributions", modality), format!("'{modality}' {problem}"));
    }
    for (modality, _) in predict.iter().filter(|(_, predict)| **predict == Predict::Change) {
        let problem = if is_image(modality) {
            "is an image; predict a modality that is its change (difference_of)".to_owned()
        } else if !input.contains(modality) {
            format!(
                "is not an input, so the network does not know to what the change is added; inputs: {}",
                list(input)
            )
        } else {
            continue;
        };
        return fault(path("predict", "predict", modality), format!("'{modality}' {problem}"));
    }
    let weight = |modality| weights.get(modality).copied().unwrap_or(1.0);
    if output.iter().all(|modality| weight(modality) == 0.0) {
        let key = if outputs.is_empty() { "training.loss_weights" } else { "outputs" };
        return fault(key, "every output has weight 0, so there is nothing to learn");
    }
    Ok(())
}

fn list(modalities: &[Modality]) -> String {
    modalities.iter().map(|modality| modality.name()).collect::<Vec<_>>().join(", ")
}

/// Refuses settings that no world has, and values that are not valid for a world's setting.
fn settings(experiment: &Experiment) -> Result<(), Fault> {
    let worlds: Vec<_> = experiment.scenarios.iter().filter_map(|origin| experiment.world(origin)).collect();
    let known: Vec<(String, Setting)> = worlds.iter().flat_map(|world| world.settings()).collect();
    let mut factors: Vec<&str> =
        worlds.iter().flat_map(|world| world.file().factors.iter()).map(|(name, _)| name).collect();
    factors.sort_unstable();
    factors.dedup();
    for (index, name) in experiment.simulation.factors.iter().enumerate() {
        // An imported dataset is not simulated: what stands here has no effect on it.
        if worlds.is_empty() || factors.contains(&name.as_str()) {
            continue;
        }
        let message = match factors.is_empty() {
            true => format!("unknown factor '{}': the world file declares none", shorten(name)),
            false => unknown("factor", name, "simulation.factors", &factors, str::to_owned),
        };
        return fault(format!("simulation.factors.{index}"), message);
    }
    for (key, value) in &experiment.simulation.world {
        let path = format!("simulation.{key}");
        if !known.iter().any(|(name, _)| name == key) {
            let fixed = Simulation::KEYS.iter().copied();
            let names: Vec<&str> = fixed.chain(known.iter().map(|(name, _)| name.as_str())).collect();
            // An imported dataset is not simulated: what stands here has no effect on it.
            if worlds.is_empty() {
                continue;
            }
            return fault(path, unknown("key", key, "simulation", &names, str::to_owned));
        }
        for world in &worlds {
            world.check_setting(key, value).or_else(|message| fault(&path, message))?;
        }
    }
    Ok(())
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

fn scaling(experiment: &Experiment) -> Result<(), Fault> {
    for (modality, given) in &experiment.scaling {
        let known: Vec<_> =
            experiment.scenarios.iter().map(|origin| experiment.known(origin, *modality)).collect();
        if known.iter().all(Option::is_none)
            && experiment.scenarios.iter().all(|o| experiment.world(o).is_some())
        {
            let worlds = experiment.scenarios.iter().filter_map(|origin| experiment.world(origin));
            let names = worlds.flat_map(|world| world.modalities().collect::<Vec<_>>()).map(Modality::name);
            let names: Vec<&str> = names.collect::<BTreeSet<_>>().into_iter().collect();
            return fault(
                format!("scaling.{modality}"),
                unknown("key", modality.name(), "scaling", &names, str::to_owned),
            );
        }
        let is_image = known.iter().flatten().any(|known| known.size.is_some());
        if is_image && given.scale == Some(Scale::PerElement) {
            return fault(
                format!("scaling.{modality}.scale"),
                format!("'{modality}' is an image, whose values share one standard deviation; use shared"),
            );
        }
    }
    Ok(())
}

/// Refuses a window that does not fit into an episode, or whose task is to return what is given.
fn window(experiment: &Experiment) -> Result<(), Fault> {
    let Experiment { window, simulation, scenarios, split, input, output, .. } = experiment;
    let samples = simulation.samples_per_episode();
    let is_simulated = scenarios.iter().any(|origin| experiment.world(origin).is_some());
    if is_simulated && window.samples() > samples {
        let longer = if window.context > window.horizon { "window.context" } else { "window.horizon" };
        return fault(
            longer,
            format!(
                "a window of {} and {} samples does not fit into an episode of {samples}; use a shorter window or more \
                 actuations_per_episode",
                window.context, window.horizon
            ),
        );
    }
    if window.horizon == 0
        && let Some(index) = output.iter().position(|modality| input.contains(modality))
    {
        let modality = &output[index];
        return fault(
            format!("output.{index}"),
            format!(
                "with window.horizon: 0, the output '{modality}' is estimated at the sample of the input '{modality}', \
                 so a model would return what it is given; leave it out of one of them, or predict ahead with \
                 window.horizon: 1"
            ),
        );
    }
    let seconds = samples as f64 / simulation.sample_rate_hz;
    let is_later = |since: &u32| is_simulated && f64::from(*since) >= seconds;
    if let Some(index) = window.since_s.iter().position(is_later) {
        return fault(
            format!("window.since_s.{index}"),
            format!("an episode lasts {seconds} s; use a shorter time or more actuations_per_episode"),
        );
    }
    if window.start == WindowStart::Rest && !split.by.keeps_episodes() {
        return fault(
            "window.start",
            format!(
                "a split by {} leaves no whole episodes to start from; use split.by: episode, or start: random",
                split.by
            ),
        );
    }
    Ok(())
}

/// Refuses a window or a split that does not suit the memory of the network, or that a network without memory can't
/// predict.
fn memory(experiment: &Experiment) -> Result<(), Fault> {
    let Experiment { window, simulation, input, output, network, training, split, .. } = experiment;
    let has_memory = network.memory != Memory::None;
    if has_memory && network.fusion == Fusion::Product {
        return fault(
            "network.fusion",
            format!(
                "a product of experts estimates the latent state of one sample, and network.memory: {} that of many; \
                 use fusion: early or late, or memory: none",
                network.memory.name()
            ),
        );
    }
    if has_memory && window.context == 1 && window.horizon <= 1 {
        return fault(
            "window.context",
            format!(
                "a network with memory needs a context of several samples, or a horizon above 1; use for example \
                 window.context: {}, or network.memory: none",
                (simulation.samples_per_episode() - window.horizon).clamp(2, 50)
            ),
        );
    }
    if has_memory && window.context == 1 && window.start == WindowStart::Rest {
        return fault(
            "window.context",
            "with window.start: rest, a network with memory is trained on sequences of several samples; use for \
             example 50, or window.start: random"
                .to_owned(),
        );
    }
    if has_memory && training.burn_in >= window.context {
        let (burn_in, context) = (training.burn_in, window.context);
        return fault(
            "training.burn_in",
            format!("a burn-in of {burn_in} samples leaves nothing of a context of {context}; use less"),
        );
    }
    if has_memory && split.by == Division::Sample {
        return fault(
            "split.by",
            "a network with memory is trained on consecutive samples, which a split by sample tears apart; use \
             episode or time"
                .to_owned(),
        );
    }
    match input.iter().find(|modality| !output.contains(modality)) {
        Some(missing) if window.horizon > 1 && !has_memory => fault(
            "window.horizon",
            format!(
                "a network without memory predicts further than one sample from its own predictions, and these lack \
                 its input '{missing}'; add it to the output, or use network.memory or horizon: 1"
            ),
        ),
        _ => Ok(()),
    }
}
