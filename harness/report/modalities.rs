//! Lists the worlds of the runs: what each senses, with elements and units.

use super::Asked;
use harness_analysis::{Analysis, Run};
use harness_spec::{Definition, Layout, Modality};
use serde::Serialize;
use std::collections::BTreeSet;

/// The largest number of elements of which each is named.
const MOST_NAMES: usize = 8;

/// What worlds sense, and which of it the networks get and predict.
#[derive(Serialize)]
pub struct World {
    /// The names of the worlds that sense the same.
    names: BTreeSet<String>,
    /// The experiments with runs in these worlds.
    experiments: BTreeSet<String>,
    modalities: Vec<Row>,
}

/// A modality in words.
#[derive(Serialize)]
struct Row {
    name: String,
    /// What is recorded: `image of 64 × 64 pixels`, or the number of values.
    what: String,
    /// The elements, each with its unit.
    elements: String,
    /// What the networks do with it: `input`, `output`, or both.
    role: String,
}

/// Returns the worlds and imported datasets of the asked experiments, with one entry for those that sense the same.
/// There are none on the page of all results.
pub fn worlds(analysis: &Analysis, asked: &Asked) -> Vec<World> {
    let mut worlds: Vec<(World, &Layout)> = Vec::new();
    for run in asked.experiments.iter().flat_map(|name| analysis.runs(name)) {
        let layout: &Layout = &run.record.layout;
        let place = worlds.iter().position(|(_, other)| *other == layout).unwrap_or_else(|| {
            let (names, experiments) = (BTreeSet::new(), BTreeSet::new());
            worlds.push((World { names, experiments, modalities: Vec::new() }, layout));
            worlds.len() - 1
        });
        worlds[place].0.names.insert(run.record.spec.scenario.to_string());
        worlds[place].0.experiments.insert(run.record.experiment.clone());
    }
    let with_modalities = |(world, layout): (World, &Layout)| {
        let of_world = |run: &&Run| *run.record.layout == *layout;
        let runs: Vec<&Run> =
            world.experiments.iter().flat_map(|name| analysis.runs(name)).filter(of_world).collect();
        let modalities = layout.modalities.iter().map(|definition| Row::new(definition, &runs)).collect();
        World { modalities, ..world }
    };
    worlds.into_iter().map(with_modalities).collect()
}

impl Row {
    fn new(definition: &Definition, runs: &[&Run]) -> Self {
        let is_in =
            |list: fn(&Run) -> &Vec<Modality>| runs.iter().any(|run| list(run).contains(&definition.name));
        let roles = [
            (definition.name == Modality::SETPOINT, "action"),
            (is_in(|run| &run.record.spec.input), "input"),
            (is_in(|run| &run.record.spec.output), "output"),
        ];
        let roles: Vec<&str> = roles.into_iter().filter_map(|(is_so, word)| is_so.then_some(word)).collect();
        let change = definition.difference_of.map(|of| format!("change of {of}, ")).unwrap_or_default();
        let what = match definition.size() {
            Some([rows, columns]) => {
                format!("{change}{} of {rows} × {columns} pixels", definition.shows())
            }
            None => format!("{change}{}", harness_shared::numbers::counted(definition.width(), "value")),
        };
        Self {
            name: definition.name.to_string(),
            what,
            elements: elements(definition),
            role: roles.join(", "),
        }
    }
}

/// The elements of a vector, by unit: `slide in m; swing, elbow in rad`. Of many, the first two and the last one.
fn elements(definition: &Definition) -> String {
    let by_unit = definition.by_unit().into_iter().map(|(unit, elements)| {
        let names: Vec<&str> =
            elements.iter().map(|element| definition.elements()[*element].name.as_str()).collect();
        let names = match names[..] {
            [first, second, .., last] if names.len() > MOST_NAMES => format!("{first}, {second} … {last}"),
            _ => names.join(", "),
        };
        match unit {
            "" | "1" => names,
            unit => format!("{names} in {unit}"),
        }
    });
    by_unit.collect::<Vec<_>>().join("; ")
}
