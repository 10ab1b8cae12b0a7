//! Modalities: their names, which specs and tables use, and what a dataset says of each.

use super::scaling::Scale;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::ops::Index;
use std::sync::{Arc, LazyLock, Mutex};

/// Colour channels of an image.
pub const IMAGE_CHANNELS: usize = 3;

/// What names of modalities, scenarios and their elements look like.
pub(super) const NAME: &str = "^[a-z][a-z0-9_]{0,63}$";

/// Whether a text matches [`NAME`].
pub fn is_name(text: &str) -> bool {
    (1..=64).contains(&text.len())
        && text.starts_with(|c: char| c.is_ascii_lowercase())
        && text.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
}

/// The one copy of a name, which lives as long as the process: names are few and short.
pub fn intern(name: &str) -> &'static str {
    static NAMES: Mutex<BTreeSet<&'static str>> = Mutex::new(BTreeSet::new());
    let mut names = NAMES.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    if let Some(known) = names.get(name) {
        return known;
    }
    let name: &'static str = Box::leak(name.into());
    names.insert(name);
    name
}

/// Gives a type around an interned name what all such names have: the text, an order, `Display` and serde. The names of
/// `$first` come first in every order, then all others by the alphabet.
macro_rules! interned_name {
    ($type:ident, first: $first:ident, refused: $refused:literal) => {
        impl $type {
            /// The one of that name; `None` where none can be called so.
            pub fn new(name: &str) -> Option<Self> {
                $crate::is_name(name).then(|| Self($crate::intern(name)))
            }

            /// The name in specs, tables and file names.
            pub const fn name(self) -> &'static str {
                self.0
            }

            fn rank(self) -> usize {
                Self::$first.iter().position(|other| *other == self).unwrap_or(Self::$first.len())
            }
        }

        impl Ord for $type {
            fn cmp(&self, other: &Self) -> std::cmp::Ordering {
                (self.rank(), self.0).cmp(&(other.rank(), other.0))
            }
        }

        impl PartialOrd for $type {
            fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
                Some(self.cmp(other))
            }
        }

        impl std::fmt::Display for $type {
            fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
                f.pad(self.0)
            }
        }

        impl serde::Serialize for $type {
            fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                serializer.serialize_str(self.0)
            }
        }

        impl<'de> serde::Deserialize<'de> for $type {
            fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                let name = String::deserialize(deserializer)?;
                let refused = || serde::de::Error::custom(format!(concat!("'{}' ", $refused), name));
                Self::new(&name).ok_or_else(refused)
            }
        }
    };
}
pub(super) use interned_name;

/// The name of a modality, as specs and tables write it. What it stands for is in the dataset's [`Layout`].
///
/// Modalities are packed in the order of their names: those of the built-in worlds first, in the order of
/// [`Modality::BUILT_IN`], then all others by the alphabet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Modality(&'static str);

impl Modality {
    /// The finger's joint angles, rad, base to tip.
    pub const PROPRIOCEPTION: Self = Self("proprioception");
    /// The arm's rotation (rad), lift (m) and extension (m).
    pub const ARM: Self = Self("arm");
    /// Normal contact force of each link at the sampling instant, N.
    pub const CONTACT_FORCE: Self = Self("contact_force");
    /// The same, averaged over the sampling interval that ends at the instant, N.
    pub const CONTACT_FORCE_MEAN: Self = Self("contact_force_mean");
    /// The external camera's image.
    pub const VISION: Self = Self("vision");
    /// This image minus the one a sample before, in [-1, 1]; zero at an episode's first sample.
    pub const FRAME_DIFFERENCE: Self = Self("frame_difference");
    /// What the actuators are commanded: every dataset records it, and the action is made of it.
    pub const SETPOINT: Self = Self("setpoint");
    /// The factors of variation that were drawn for an episode, the same at each of its samples: recorded where a spec turns
    /// any on.
    pub const FACTORS: Self = Self("factors");

    /// The modalities of the built-in worlds that a spec can name.
    pub const BUILT_IN: [Self; 6] = [
        Self::PROPRIOCEPTION,
        Self::ARM,
        Self::CONTACT_FORCE,
        Self::CONTACT_FORCE_MEAN,
        Self::VISION,
        Self::FRAME_DIFFERENCE,
    ];

    /// Names that mean something else in a column, a loss term or a saved network.
    pub(super) const RESERVED: [&str; 10] =
        ["dataset", "scenario", "episode", "sample", "time", "setpoint", "factors", "action", "kl", "total"];
}

interned_name!(
    Modality,
    first: BUILT_IN,
    refused: "can't name a modality; use lower-case letters, digits and '_', a letter first"
);

/// The modalities of the built-in worlds by name, and any other name.
impl JsonSchema for Modality {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "Modality".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        let built_in = Layout::finger();
        let choices = Modality::BUILT_IN.iter().map(|modality| {
            serde_json::json!({
                "description": built_in[*modality].meaning, "type": "string", "const": modality.name(),
            })
        });
        let other = serde_json::json!({
            "description": "A modality of another world, or of an imported dataset.", "type": "string", "pattern": NAME,
        });
        let choices: Vec<_> = choices.chain([other]).collect();
        json_schema!({ "description": "What is sensed at a sample.", "oneOf": choices })
    }
}

/// One value of a vector.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Element {
    /// The end of its column's name: `rotation` in `arm_rotation`.
    pub name: String,
    /// SI unit; empty where none is known.
    #[serde(default)]
    pub unit: String,
}

/// What a modality's values are.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Kind {
    Vector {
        elements: Vec<Element>,
    },
    /// RGB, of so many rows and columns.
    Image {
        size: [usize; 2],
    },
}

/// Elements that metrics sum up together.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Group {
    /// As the tables' column `direction` has it.
    pub name: String,
    pub elements: Vec<usize>,
}

/// How errors are given in percent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Percentage {
    /// Symmetric mean absolute percentage error, for values of either sign.
    Smape,
    /// Mean absolute error over the mean absolute value, for values that are often 0.
    Wmape,
}

/// What a dataset says of one of its modalities.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Definition {
    pub name: Modality,
    /// In a sentence.
    #[serde(default)]
    pub meaning: String,
    #[serde(flatten)]
    pub kind: Kind,
    /// The modality of which this is the change since the sample before; it is computed, not stored.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub difference_of: Option<Modality>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub groups: Vec<Group>,
    /// What its values are divided by for a network, where a spec says nothing.
    pub scale: Scale,
    /// The least value of a prediction, where a spec says nothing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub minimum: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub percentage: Option<Percentage>,
}

impl Definition {
    /// Whether it is an image rather than a vector.
    pub fn is_image(&self) -> bool {
        matches!(self.kind, Kind::Image { .. })
    }

    /// Rows and columns of an image.
    pub fn size(&self) -> Option<[usize; 2]> {
        match self.kind {
            Kind::Image { size } => Some(size),
            Kind::Vector { .. } => None,
        }
    }

    /// Values of one sample.
    pub fn width(&self) -> usize {
        match &self.kind {
            Kind::Image { size: [rows, columns] } => rows * columns * IMAGE_CHANNELS,
            Kind::Vector { elements } => elements.len(),
        }
    }

    /// The elements of a vector.
    pub fn elements(&self) -> &[Element] {
        match &self.kind {
            Kind::Image { .. } => &[],
            Kind::Vector { elements } => elements,
        }
    }

    /// The columns that hold a vector's elements.
    pub fn columns(&self) -> impl Iterator<Item = String> {
        self.elements().iter().map(|element| format!("{}_{}", self.name, element.name))
    }

    /// The unit that all values share; `None` where they differ, so that they can't be summed up together.
    pub fn unit(&self) -> Option<&str> {
        match &self.kind {
            Kind::Image { .. } => Some("1"),
            Kind::Vector { elements } => {
                let unit = elements.first().map_or("", |element| element.unit.as_str());
                elements.iter().all(|element| element.unit == unit).then_some(unit)
            }
        }
    }

    /// Whether its values are contact forces, of which the table `forces` keeps the distribution.
    pub fn is_force(&self) -> bool {
        !self.is_image() && self.unit() == Some("N")
    }

    /// The first group that an element belongs to.
    pub fn group_of(&self, element: usize) -> Option<&Group> {
        self.groups.iter().find(|group| group.elements.contains(&element))
    }

    /// The last element of each group, or of all where there are none.
    pub fn last_elements(&self) -> Vec<usize> {
        match self.groups.as_slice() {
            [] => self.width().checked_sub(1).into_iter().collect(),
            groups => groups.iter().filter_map(|group| group.elements.last().copied()).collect(),
        }
    }
}

/// A part of what images show, whose error is reported apart.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Region {
    pub name: String,
    /// It is told by its colour: (red - blue) / brightest channel lies in this range, the upper bound excluded.
    pub red_minus_blue: [f32; 2],
}

/// What the samples of a dataset hold. It stands in `dataset.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Layout {
    /// Its modalities, [`Modality::SETPOINT`] among them, in the order of the columns.
    pub modalities: Vec<Definition>,
    /// Where two fit a pixel, it belongs to the later one.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub regions: Vec<Region>,
}

impl Layout {
    /// That of the built-in worlds `empty` and `cluttered`, and of every dataset and run from before datasets said what
    /// they hold.
    pub fn finger() -> Arc<Self> {
        static FINGER: LazyLock<Arc<Layout>> = LazyLock::new(|| {
            let text = include_str!("../../models/finger.json");
            Arc::new(serde_json::from_str(text).expect("a test reads models/finger.json"))
        });
        FINGER.clone()
    }

    /// This layout and what was drawn for each episode.
    pub fn with_factors(&self, elements: Vec<Element>) -> Self {
        let mut layout = self.clone();
        layout.modalities.push(Definition {
            name: Modality::FACTORS,
            meaning: "What the episode drew for factor".into(),
            kind: Kind::Vector { elements },
            difference_of: None,
            groups: Vec::new(),
            scale: Scale::PerElement,
            minimum: None,
            percentage: None,
        });
        layout
    }

    /// What it says of a modality.
    pub fn get(&self, modality: Modality) -> Option<&Definition> {
        self.modalities.iter().find(|definition| definition.name == modality)
    }

    /// Where a modality stands.
    pub fn position(&self, modality: Modality) -> Option<usize> {
        self.modalities.iter().position(|definition| definition.name == modality)
    }

    /// The elements of the action, and of what the actuators are commanded.
    pub fn action(&self) -> &[Element] {
        self.get(Modality::SETPOINT).map_or(&[], |definition| definition.elements())
    }

    /// The vectors that are stored, in the order of their columns.
    pub fn stored_vectors(&self) -> impl Iterator<Item = &Definition> {
        self.modalities
            .iter()
            .filter(|definition| !definition.is_image() && definition.difference_of.is_none())
    }

    /// The images that are stored.
    pub fn stored_images(&self) -> impl Iterator<Item = &Definition> {
        self.modalities
            .iter()
            .filter(|definition| definition.is_image() && definition.difference_of.is_none())
    }

    /// What a spec can name as an input or output.
    pub fn names(&self) -> impl Iterator<Item = Modality> {
        let names = self.modalities.iter().map(|definition| definition.name);
        names.filter(|name| ![Modality::SETPOINT, Modality::FACTORS].contains(name))
    }
}

/// For modalities that are known to be there, since the spec was compared with the layout.
impl Index<Modality> for Layout {
    type Output = Definition;

    fn index(&self, modality: Modality) -> &Definition {
        self.get(modality).unwrap_or_else(|| panic!("the dataset's layout holds no {modality}"))
    }
}
