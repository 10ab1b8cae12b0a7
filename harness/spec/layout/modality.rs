//! Modalities: their names, which specs and tables use, and their definitions, which a dataset stores.

use super::{intern, interned_name, names};
use crate::yaml::NAME;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Serialize};
use std::ops::Index;
use std::sync::{Arc, LazyLock};

/// What the name of a force's contact kinds adds to the name of the force.
pub const CONTACT_KIND: &str = "_kind";

/// The region of a force's elements without a contact.
pub const NO_CONTACT: &str = "none";

/// The parts of the predictions of a force that have metrics of their own besides its kinds of contact: those with a
/// contact at the predicted sample, and the phases, by the contact at the present sample and at the predicted one.
pub const CONTACT_PARTS: [&str; 5] = ["contact", "onset", "sustained", "release", "free"];

/// Number of elements of a vector in space.
pub const AXES: usize = 3;

/// Number of color channels of an image.
pub const IMAGE_CHANNELS: usize = 3;

/// The colors of a segmentation's classes, with their names. Pixels of no class are black.
pub const CLASS_COLORS: [(&str, [u8; IMAGE_CHANNELS]); 7] = [
    ("red", [255, 0, 0]),
    ("green", [0, 255, 0]),
    ("blue", [0, 0, 255]),
    ("yellow", [255, 255, 0]),
    ("cyan", [0, 255, 255]),
    ("magenta", [255, 0, 255]),
    ("white", [255, 255, 255]),
];

/// The name of a modality in specs and tables. The dataset's [`Layout`] defines the modality.
///
/// Modalities are ordered by name: those of the built-in worlds come first, in the order of [`Modality::BUILT_IN`], and
/// all others follow in alphabetical order. Networks take them in this order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Modality(&'static str);

impl Modality {
    /// The finger's joint angles, rad, base to tip.
    pub const PROPRIOCEPTION: Self = Self("proprioception");
    /// The arm's rotation (rad), lift (m) and extension (m).
    pub const ARM: Self = Self("arm");
    /// Normal contact force of each link at the sampling instant, N.
    pub const CONTACT_FORCE: Self = Self("contact_force");
    /// Normal contact force of each link, averaged over the sampling interval that ends at the sample, N.
    pub const CONTACT_FORCE_MEAN: Self = Self("contact_force_mean");
    /// The external camera's image.
    pub const VISION: Self = Self("vision");
    /// The external camera's image minus the one of the sample before, in [-1, 1]; zero at an episode's first sample.
    pub const FRAME_DIFFERENCE: Self = Self("frame_difference");
    /// The setpoints of the actuators, from which the action is computed. Recordings of passive systems have none.
    pub const SETPOINT: Self = Self("setpoint");
    /// The values of the factors of variation that were drawn for an episode, the same at each of its samples. They are
    /// recorded only if the spec turns on a factor.
    pub const FACTORS: Self = Self("factors");

    /// The latent state of a network, about which the table of metrics has rows. No dataset records it.
    pub const LATENT: Self = Self("latent");

    /// The modalities of the built-in worlds that a spec can name.
    pub const BUILT_IN: [Self; 6] = [
        Self::PROPRIOCEPTION,
        Self::ARM,
        Self::CONTACT_FORCE,
        Self::CONTACT_FORCE_MEAN,
        Self::VISION,
        Self::FRAME_DIFFERENCE,
    ];

    /// Names that a modality can't have, because columns, loss terms or saved networks use them for something else.
    pub const RESERVED: [&str; 11] = [
        "dataset", "scenario", "episode", "sample", "time", "setpoint", "factors", "action", "kl", "total",
        "latent",
    ];

    /// Returns whether a dataset's modality is sensed: it is neither the setpoint nor the drawn factors.
    pub fn is_sensed(self) -> bool {
        ![Self::SETPOINT, Self::FACTORS].contains(&self)
    }
}

interned_name!(
    Modality,
    first: BUILT_IN,
    refused: "can't name a modality; use lower-case letters, digits and '_', a letter first"
);

/// Accepts the modalities of the built-in worlds, which editors complete, and any other valid name.
impl JsonSchema for Modality {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "Modality".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        const CHOICES: [(Modality, &str); Modality::BUILT_IN.len()] = [
            (Modality::PROPRIOCEPTION, "The angles of the finger's joints, rad."),
            (Modality::ARM, "The arm's rotation (rad), lift (m) and extension (m)."),
            (Modality::CONTACT_FORCE, "The normal contact force on each link at the sample, N."),
            (
                Modality::CONTACT_FORCE_MEAN,
                "The normal contact force on each link, averaged over the time since the previous sample, N.",
            ),
            (Modality::VISION, "The image of the external camera."),
            (Modality::FRAME_DIFFERENCE, "The change of the image since the previous sample."),
        ];
        let choices = CHOICES.map(|(modality, meaning)| {
            serde_json::json!({ "description": meaning, "type": "string", "const": modality.name() })
        });
        let other = serde_json::json!({
            "description": "A modality of another world, or of an imported dataset.", "type": "string", "pattern": NAME,
        });
        let choices: Vec<_> = choices.into_iter().chain([other]).collect();
        json_schema!({ "description": "A modality, which is recorded at each sample.", "oneOf": choices })
    }
}

/// One element of a vector.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Element {
    /// The end of its column's name: `rotation` in `arm_rotation`.
    pub name: String,
    /// SI unit; empty if it is unknown.
    #[serde(default)]
    pub unit: String,
}

/// Whether a modality is a vector or an image.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Kind {
    /// A vector of numbers.
    Vector {
        /// Names and units of the elements, in the order of the columns.
        elements: Vec<Element>,
    },
    /// An RGB image.
    Image {
        /// Rows and columns, pixels.
        size: [usize; 2],
    },
}

/// Elements for which metrics are computed together.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Group {
    /// Name of the group in the column `direction` of the tables.
    pub name: String,
    /// Indices of the elements in the vector.
    pub elements: Vec<usize>,
}

/// The standard deviation by which a modality's values are divided, after each value's own mean is subtracted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Scale {
    /// One standard deviation for all values. Errors have the same relative weight as in physical units.
    Shared,
    /// Each value's own standard deviation. A value that hardly varies has the same weight as all others. Images can't
    /// have it.
    PerElement,
}
names!(Scale { Shared => "shared", PerElement => "per_element" });

/// How errors are given in percent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Percentage {
    /// Symmetric mean absolute percentage error, for values of either sign.
    Smape,
    /// Mean absolute error over the mean absolute value, for values that are often 0.
    Wmape,
}

/// The classes that a segmentation tells apart.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Segmentation {
    /// Names of the classes, in the order of [`CLASS_COLORS`].
    pub classes: Vec<String>,
    /// The images of the same camera and size. The classes are their regions.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub of: Vec<Modality>,
}

/// The definition of one modality of a dataset.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Definition {
    /// Name of the modality.
    pub name: Modality,
    /// Description of the modality in one sentence.
    #[serde(default)]
    pub meaning: String,
    /// Whether it is a vector or an image, with its elements or its size.
    #[serde(flatten)]
    pub kind: Kind,
    /// If this modality is the change of another one since the sample before: the other one. It is then computed, not
    /// stored.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub difference_of: Option<Modality>,
    /// Whether an image encodes optical flow, or the change of one, instead of colors.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub optical_flow: bool,
    /// The depths, m, at which the red of an image that encodes depth is 0 and 255.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub depth_range_m: Option<[f64; 2]>,
    /// If an image encodes classes, or is the change of one that does: the classes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub segmentation: Option<Segmentation>,
    /// Groups of elements for which metrics are computed together.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub groups: Vec<Group>,
    /// Names of the kinds of contact of a force, for which metrics are computed separately. The modality
    /// [`Definition::contact_kind`] has the kind of each element.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub contact_kinds: Vec<String>,
    /// If a vector is a set of objects: their number. The values of an object lie side by side, and each object has the
    /// same values. Networks treat the objects alike.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub objects: Option<usize>,
    /// Whether the elements of a vector are categories: one of them is 1 at each sample, and all others are 0. Its
    /// predictions are the probabilities of the categories.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub category: bool,
    /// Whether each [`AXES`] elements of a vector are a unit vector in space, or all 0 where there is none, such as where
    /// a link touches nothing. Networks learn only the direction, where there is one, and only its angle is judged.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub unit_vectors: bool,
    /// Which standard deviation the values are divided by for a network, if the spec does not say.
    pub scale: Scale,
    /// The least value of a prediction, in physical units, if the spec does not say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub minimum: Option<f64>,
    /// How errors are given in percent; `None` if they are not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub percentage: Option<Percentage>,
}

impl Definition {
    /// Returns the definition of a vector without groups, whose elements each have a scale of their own.
    pub fn vector(name: Modality, meaning: impl Into<String>, elements: Vec<Element>) -> Self {
        Self {
            name,
            meaning: meaning.into(),
            kind: Kind::Vector { elements },
            difference_of: None,
            optical_flow: false,
            depth_range_m: None,
            segmentation: None,
            groups: Vec::new(),
            contact_kinds: Vec::new(),
            objects: None,
            category: false,
            unit_vectors: false,
            scale: Scale::PerElement,
            minimum: None,
            percentage: None,
        }
    }

    /// Returns whether the modality is an image rather than a vector.
    pub fn is_image(&self) -> bool {
        matches!(self.kind, Kind::Image { .. })
    }

    /// Returns whether a network learns it by a loss of its own, and a spec can't set its scaling: categories and unit
    /// vectors.
    pub fn has_own_loss(&self) -> bool {
        self.category || self.unit_vectors
    }

    /// Returns whether an image, or the change of one, encodes something else than the colors that a camera sees.
    pub fn is_coded(&self) -> bool {
        self.optical_flow || self.depth_range_m.is_some() || self.segmentation.is_some()
    }

    /// Returns what an image shows, in words: `image` if it shows colors.
    pub fn shows(&self) -> &'static str {
        match (self.optical_flow, self.depth_range_m, &self.segmentation) {
            (true, ..) => "optical flow",
            (_, Some(_), _) => "depth image",
            (.., Some(_)) => "segmentation",
            _ => "image",
        }
    }

    /// Returns the rows and columns of an image; `None` for a vector.
    pub fn size(&self) -> Option<[usize; 2]> {
        match self.kind {
            Kind::Image { size } => Some(size),
            Kind::Vector { .. } => None,
        }
    }

    /// Returns the number of values of one sample.
    pub fn width(&self) -> usize {
        match &self.kind {
            Kind::Image { size: [rows, columns] } => rows * columns * IMAGE_CHANNELS,
            Kind::Vector { elements } => elements.len(),
        }
    }

    /// Returns the elements of a vector; none for an image.
    pub fn elements(&self) -> &[Element] {
        match &self.kind {
            Kind::Image { .. } => &[],
            Kind::Vector { elements } => elements,
        }
    }

    /// Returns the names of the columns that hold a vector's elements.
    pub fn columns(&self) -> impl Iterator<Item = String> {
        self.elements().iter().map(|element| format!("{}_{}", self.name, element.name))
    }

    /// Returns the unit of all values; `None` if the units differ, so that no common error can be computed.
    pub fn unit(&self) -> Option<&str> {
        match &self.kind {
            Kind::Image { .. } => Some("1"),
            Kind::Vector { elements } => one_unit(elements.iter()),
        }
    }

    /// Returns the unit of some values; `None` if the units differ.
    pub fn unit_of(&self, elements: &[usize]) -> Option<&str> {
        match &self.kind {
            Kind::Image { .. } => self.unit(),
            Kind::Vector { elements: all } => one_unit(elements.iter().filter_map(|index| all.get(*index))),
        }
    }

    /// Returns the units of a vector's elements, and the elements with each, in the order of the first ones.
    pub fn by_unit(&self) -> Vec<(&str, Vec<usize>)> {
        let mut units: Vec<(&str, Vec<usize>)> = Vec::new();
        for (index, Element { unit, .. }) in self.elements().iter().enumerate() {
            match units.iter_mut().find(|(other, _)| other == unit) {
                Some((_, elements)) => elements.push(index),
                None => units.push((unit, vec![index])),
            }
        }
        units
    }

    /// Returns whether another definition is of the same values, so that a network can't tell. The contacts of a force
    /// may be of other kinds. Its least predicted value is a setting of the run.
    pub fn is_like(&self, other: &Self) -> bool {
        let plain = |of: &Self| Self {
            meaning: String::new(),
            contact_kinds: Vec::new(),
            minimum: None,
            ..of.clone()
        };
        plain(self) == plain(other)
    }

    /// Returns whether the values are sensed forces: a vector in N. The table `forces` holds their distribution.
    pub fn is_force(&self) -> bool {
        self.name.is_sensed() && !self.is_image() && self.unit() == Some("N")
    }

    /// Returns the modality that tells the kind of contact of each element: 0 without a contact, k for the contact kind
    /// k - 1, and the number after the last kind for any other contact. `None` without kinds.
    pub fn contact_kind(&self) -> Option<Modality> {
        let name = || Modality(intern(&format!("{}{CONTACT_KIND}", self.name)));
        (!self.contact_kinds.is_empty()).then(name)
    }

    /// Returns the names of the parts of the values that have metrics of their own, in the order of the values of
    /// [`Definition::contact_kind`]: `none` and the kinds of contact. There are none without kinds.
    pub fn contact_regions(&self) -> impl Iterator<Item = String> {
        let none = (!self.contact_kinds.is_empty()).then(|| NO_CONTACT.to_owned());
        none.into_iter().chain(self.contact_kinds.iter().cloned())
    }

    /// Returns the first group that contains an element.
    pub fn group_of(&self, element: usize) -> Option<&Group> {
        self.groups.iter().find(|group| group.elements.contains(&element))
    }

    /// Returns the last element of each group, or the last element of the vector if it has no groups.
    pub fn last_elements(&self) -> Vec<usize> {
        match self.groups.as_slice() {
            [] => self.width().checked_sub(1).into_iter().collect(),
            groups => groups.iter().filter_map(|group| group.elements.last().copied()).collect(),
        }
    }
}

fn one_unit<'a>(mut elements: impl Iterator<Item = &'a Element>) -> Option<&'a str> {
    let unit = elements.next().map_or("", |element| element.unit.as_str());
    elements.all(|element| element.unit == unit).then_some(unit)
}

/// A part of the images for which a separate error is reported.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Region {
    /// Name of the region in the tables.
    pub name: String,
    /// A pixel belongs to the region if (red - blue) / brightest channel lies in this range, the upper bound excluded.
    pub red_minus_blue: [f32; 2],
}

/// Describes the samples of a dataset. It is stored in `dataset.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Layout {
    /// The modalities, including [`Modality::SETPOINT`] if there is one, in the order of the columns.
    pub modalities: Vec<Definition>,
    /// The regions of the images of cameras without a segmentation, which colors tell. A pixel that matches several
    /// regions belongs to the last of them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub regions: Vec<Region>,
    /// The labels that each episode of an imported dataset has.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub labels: Vec<Label>,
}

/// A label of episodes, such as the object that was touched. It has one value in an episode.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Label {
    /// Its name, which is a column of the table `episodes`.
    pub name: String,
    /// What its values are.
    pub kind: LabelKind,
}

/// What the values of a label are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LabelKind {
    /// Texts.
    Text,
    /// Integers.
    Integer,
    /// Numbers.
    Real,
}

impl Layout {
    /// Returns the layout of the paper's worlds `empty` and `cluttered`, without the kinds of contacts and the modalities
    /// that they record in addition.
    pub fn finger() -> Arc<Self> {
        static FINGER: LazyLock<Arc<Layout>> = LazyLock::new(|| {
            let text = include_str!("../../../models/finger.json");
            Arc::new(serde_json::from_str(text).expect("a test reads models/finger.json"))
        });
        FINGER.clone()
    }

    /// Returns the layout without the modality [`Modality::FACTORS`], which is the last one.
    pub fn without_factors(&self) -> Self {
        let mut layout = self.clone();
        layout.modalities.retain(|definition| definition.name != Modality::FACTORS);
        layout
    }

    /// Returns the layout with the modality [`Modality::FACTORS`] added, which has these elements.
    pub fn with_factors(&self, elements: Vec<Element>) -> Self {
        let mut layout = self.clone();
        let meaning = "What the episode drew for factor";
        layout.modalities.push(Definition::vector(Modality::FACTORS, meaning, elements));
        layout
    }

    /// Returns the modalities of another layout that are like those of this one, as the other one defines them. The kinds
    /// of contact of a force are those of the other layout.
    pub fn shared_with(&self, other: &Self) -> Self {
        let mut layout = other.clone();
        let is_like =
            |definition: &Definition| self.get(definition.name).is_some_and(|own| own.is_like(definition));
        layout.modalities.retain(is_like);
        let names: Vec<Modality> = layout.modalities.iter().map(|definition| definition.name).collect();
        layout.modalities.retain(|definition| definition.difference_of.is_none_or(|of| names.contains(&of)));
        for definition in &mut layout.modalities {
            if definition.contact_kind().is_some_and(|kind| !names.contains(&kind)) {
                definition.contact_kinds.clear();
            }
        }
        layout
    }

    /// Returns the definition of a modality; `None` if the layout has no such modality.
    pub fn get(&self, modality: Modality) -> Option<&Definition> {
        self.modalities.iter().find(|definition| definition.name == modality)
    }

    /// Returns the index of a modality in `modalities`.
    pub fn position(&self, modality: Modality) -> Option<usize> {
        self.modalities.iter().position(|definition| definition.name == modality)
    }

    /// Returns the elements of the action, which are those of the setpoint; none without a setpoint.
    pub fn action(&self) -> &[Element] {
        self.get(Modality::SETPOINT).map_or(&[], |definition| definition.elements())
    }

    /// Returns the vectors that are stored, in the order of their columns.
    pub fn stored_vectors(&self) -> impl Iterator<Item = &Definition> {
        self.modalities
            .iter()
            .filter(|definition| !definition.is_image() && definition.difference_of.is_none())
    }

    /// Returns the images that are stored.
    pub fn stored_images(&self) -> impl Iterator<Item = &Definition> {
        self.modalities
            .iter()
            .filter(|definition| definition.is_image() && definition.difference_of.is_none())
    }

    /// Returns the images of cameras, which are all stored images that encode nothing else than colors.
    pub fn camera_images(&self) -> impl Iterator<Item = &Definition> {
        self.stored_images().filter(|definition| !definition.is_coded())
    }

    /// Returns the segmentation whose classes are the regions of an image, or of the change of one, and the classes.
    /// `None` if no segmentation of the same camera and size is recorded; colors then tell the regions.
    pub fn segmentation_of(&self, modality: Modality) -> Option<(Modality, &[String])> {
        let image = self.get(modality)?.difference_of.unwrap_or(modality);
        self.stored_images().find_map(|definition| {
            let Segmentation { classes, of } = definition.segmentation.as_ref()?;
            of.contains(&image).then_some((definition.name, classes.as_slice()))
        })
    }

    /// Returns the names of the regions of an image, or of the change of one.
    pub fn regions_of(&self, modality: Modality) -> Vec<String> {
        match self.segmentation_of(modality) {
            Some((_, classes)) => classes.to_vec(),
            None => self.regions.iter().map(|region| region.name.clone()).collect(),
        }
    }

    /// Returns the modalities that a spec can name as inputs or outputs.
    pub fn names(&self) -> impl Iterator<Item = Modality> {
        let names = self.modalities.iter().map(|definition| definition.name);
        let is_kind = |name| self.modalities.iter().any(|definition| definition.contact_kind() == Some(name));
        names.filter(move |name| name.is_sensed() && !is_kind(*name))
    }
}

/// Returns the definition of a modality. Indexing panics if the layout has no such modality, so use it only after the
/// spec was compared with the layout.
impl Index<Modality> for Layout {
    type Output = Definition;

    fn index(&self, modality: Modality) -> &Definition {
        self.get(modality).unwrap_or_else(|| panic!("the dataset's layout holds no {modality}"))
    }
}

/// The schema of a section with a value for each modality. It lists the modalities of the built-in worlds, which
/// editors complete, and allows all others.
pub fn by_modality(value: Schema) -> Schema {
    let value = value.to_value();
    let properties: serde_json::Map<_, _> =
        Modality::BUILT_IN.iter().map(|modality| (modality.name().to_owned(), value.clone())).collect();
    json_schema!({ "type": "object", "properties": properties, "additionalProperties": value })
}
