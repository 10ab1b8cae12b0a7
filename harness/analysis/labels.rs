//! Short names of variants and of the values of settings, in the order of the specs.

use super::{Analysis, Key};
use harness_shared::numbers::Natural;
use harness_spec::{Modality, is_axis, model_parts, variant_parts};
use std::collections::{BTreeMap, BTreeSet, HashMap};

/// The keys of the modalities that a model gets and predicts.
const INPUT: &str = "input";
const OUTPUT: &str = "output";
/// The least number of modalities of which each can be left out so that the others are more than one.
const LEAST_LEFT_OUT: usize = 3;

/// The short name of a value. Values are sorted as in the specs of their experiments, and by name if that is not known.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Label {
    place: usize,
    name: Natural,
}

impl Label {
    /// The name.
    pub fn text(&self) -> &str {
        self.name.text()
    }

    /// The same label, called `name` if it has no name, at the same place among the others.
    pub fn or(self, name: &str) -> Self {
        if self.text().is_empty() { Self { name: Natural::new(name), ..self } } else { self }
    }
}

impl From<String> for Label {
    fn from(name: String) -> Self {
        Self { place: 0, name: Natural::new(name) }
    }
}

/// The short names of the variants of an analysis, and of the settings by which its means are told apart.
///
/// A variant's name has only the parts in which variants differ: `hidden=8`. A label is its name alone, and an input is
/// its modalities: `vision + touch`. If the inputs are one input and this input without some of its modalities, one
/// each, they are called `all inputs` and `without vision`.
pub struct Labels {
    variants: BTreeMap<String, usize>,
    /// The smallest place of the variants whose runs have a value, by key and value.
    values: HashMap<(&'static str, String), usize>,
    /// The parts that all variants have.
    constant: BTreeSet<String>,
    /// The input without which no modality is left out.
    whole: Option<BTreeSet<String>>,
}

impl Labels {
    /// The names of the variants of the runs that count, and of the settings among `keys`.
    pub fn new(analysis: &Analysis, keys: &[Key]) -> Self {
        let runs = || analysis.experiments().flat_map(|experiment| analysis.runs(experiment));
        let mut variants: BTreeMap<String, usize> = BTreeMap::new();
        for run in runs() {
            let place = variants.entry(varied(&run.record.spec.variant).to_owned()).or_default();
            // A run that was made alone is the first one of its command.
            *place = run.record.place.max(*place);
        }
        let named = || variants.keys().filter(|variant| !variant.is_empty() && !is_trial(variant));
        let parts = |variant: &String| variant.split(',').map(str::to_owned).collect::<BTreeSet<_>>();
        let constant = match named().count() {
            0 | 1 => BTreeSet::new(),
            _ => named()
                .map(parts)
                .reduce(|all, own| all.intersection(&own).cloned().collect())
                .unwrap_or_default(),
        };
        let mut values: HashMap<(&'static str, String), usize> = HashMap::new();
        let settings: Vec<&'static str> = keys.iter().copied().filter_map(Key::setting).collect();
        for run in runs() {
            let place = variants[varied(&run.record.spec.variant)];
            for key in &settings {
                let first = values.entry((*key, run.setting(key).to_owned())).or_insert(place);
                *first = place.min(*first);
            }
        }
        let of_variants =
            named().flat_map(|variant| variant.split(',')).filter_map(|part| part.strip_prefix("input="));
        let of_values = values.keys().filter(|(key, _)| *key == INPUT).map(|(_, value)| value.as_str());
        let inputs = of_variants.map(|input| modalities(input)).chain(of_values.map(modalities));
        let whole = whole(&inputs.map(|input| input.into_iter().map(str::to_owned).collect()).collect());
        Self { variants, values, constant, whole }
    }

    /// The name of a variant. That of a trial is the whole variant.
    pub fn variant(&self, variant: &str) -> Label {
        let own = varied(variant);
        let place = self.variants.get(own).copied().unwrap_or_default();
        if is_trial(variant) {
            return Label { place, name: Natural::new(variant) };
        }
        let parts = variant.split(',').filter(|part| !self.constant.contains(*part));
        let name = |part: &str| match part.split_once('=') {
            Some((INPUT, input)) => self.input(&modalities(input)),
            Some((axis, label)) if has_own_words(axis) => label.to_owned(),
            _ => part.to_owned(),
        };
        Label { place, name: Natural::new(parts.map(name).collect::<Vec<_>>().join(", ")) }
    }

    /// The name of the value of a setting.
    pub fn value(&self, key: &'static str, value: &str) -> Label {
        let place = self.values.get(&(key, value.to_owned())).copied().unwrap_or_default();
        let name = match key {
            INPUT => self.input(&modalities(value)),
            OUTPUT => joined(&modalities(value)),
            _ => value.replace(['[', ']', '"'], "").replace(',', "+"),
        };
        Label { place, name: Natural::new(name) }
    }

    /// The name of what a model got; `None` for all of its run's input, which comes first.
    pub fn given(&self, given: Option<&str>) -> Label {
        let name =
            given.map_or("all inputs".to_owned(), |given| joined(&given.split(',').collect::<Vec<_>>()));
        Label { place: usize::from(given.is_some()), name: Natural::new(name) }
    }

    fn input(&self, modalities: &[&str]) -> String {
        let Some(whole) = &self.whole else { return joined(modalities) };
        let left_out: Vec<&str> =
            whole.iter().map(String::as_str).filter(|modality| !modalities.contains(modality)).collect();
        match left_out.first() {
            None => "all inputs".to_owned(),
            Some(modality) => format!("without {modality}"),
        }
    }
}

/// The variant without the name of an external model.
fn varied(variant: &str) -> &str {
    model_parts(variant).0
}

fn is_trial(variant: &str) -> bool {
    variant_parts(variant).1.is_some()
}

/// The modalities of a setting's value (`["vision","touch"]`), or of a part of a variant (`vision+touch`).
fn modalities(text: &str) -> Vec<&str> {
    let is_name = |character: char| character.is_ascii_alphanumeric() || character == '_';
    text.split(|character| !is_name(character)).filter(|name| !name.is_empty()).collect()
}

/// The names of modalities, each with what is wrong with its sensor, in the order of [`Modality`].
fn joined(names: &[&str]) -> String {
    let modality = |name: &&str| Modality::new(name.split(' ').next().unwrap_or_default());
    let mut names: Vec<&str> = names.iter().copied().filter(|name| modality(name).is_some()).collect();
    names.sort_by_key(modality);
    names.join(" + ")
}

/// The one of several inputs that has all modalities, if each of the others lacks exactly one of them.
fn whole(inputs: &BTreeSet<BTreeSet<String>>) -> Option<BTreeSet<String>> {
    let largest = inputs.iter().max_by_key(|input| input.len())?;
    let lacks_one = |input: &BTreeSet<String>| input.is_subset(largest) && input.len() + 1 == largest.len();
    let others = || inputs.iter().filter(|input| *input != largest);
    (largest.len() >= LEAST_LEFT_OUT && others().count() > 1 && others().all(lacks_one))
        .then(|| largest.clone())
}

/// Whether the labels of the axis with this name say what they are. Those of other keys stand behind the key's name.
pub(super) fn has_own_words(key: &str) -> bool {
    key != "reading" && is_axis(key)
}
