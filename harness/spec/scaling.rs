//! How a modality's values are scaled for a network, and what range its predictions have.

use super::types::{Modality, names};
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize};
use std::collections::BTreeMap;
use std::fmt;

/// What a modality's values are divided by, each minus its own mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Deviation {
    /// One standard deviation for all values: errors count as they do in physical units.
    Shared,
    /// Each value's own standard deviation: a value that hardly varies counts as much as any other. Not for frames.
    PerElement,
}
names!(Deviation { Shared => "shared", PerElement => "per_element" });

/// How one modality is scaled and bounded.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scaling {
    pub scale: Deviation,
    /// The least value of a prediction, in physical units; predictions below it are set to it.
    pub minimum: Option<f64>,
}

/// One scaling a modality.
pub type Scalings = BTreeMap<Modality, Scaling>;

impl Scaling {
    /// What a modality has where a spec says nothing.
    ///
    /// Forces share a deviation because the fingertip has most of their variance, and links that are hardly ever
    /// touched would count twenty times as much. No force is negative.
    pub fn default_of(modality: Modality) -> Self {
        match modality {
            Modality::ContactForce | Modality::ContactForceMean => {
                Self { scale: Deviation::Shared, minimum: Some(0.0) }
            }
            _ => Self::plain(modality),
        }
    }

    /// What a modality had before it was a setting: a vector's elements scaled one by one, and no minimum.
    pub fn plain(modality: Modality) -> Self {
        let scale = if modality.is_frame() { Deviation::Shared } else { Deviation::PerElement };
        Self { scale, minimum: None }
    }
}

/// Every modality's default.
pub(super) fn defaults() -> Scalings {
    Modality::ALL.iter().map(|&modality| (modality, Scaling::default_of(modality))).collect()
}

/// What a spec says of some modalities, and the defaults of the others.
pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Scalings, D::Error> {
    #[derive(Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Given {
        scale: Option<Deviation>,
        /// `Some(None)` is a `null` that stands in the spec.
        #[serde(default, deserialize_with = "present")]
        minimum: Option<Option<f64>>,
    }
    fn present<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Option<f64>>, D::Error> {
        Option::deserialize(deserializer).map(Some)
    }
    let mut scalings = defaults();
    for (modality, given) in BTreeMap::<Modality, Given>::deserialize(deserializer)? {
        let default = Scaling::default_of(modality);
        let scale = given.scale.unwrap_or(default.scale);
        scalings.insert(modality, Scaling { scale, minimum: given.minimum.unwrap_or(default.minimum) });
    }
    Ok(scalings)
}

/// A section a modality, each with the keys of [`Scaling`].
pub(super) fn schema(generator: &mut SchemaGenerator) -> Schema {
    let scale = generator.subschema_for::<Deviation>();
    let minimum = json_schema!({
        "description": "The least value of a prediction, in physical units; `null` for none.",
        "type": ["number", "null"],
    });
    let section = json_schema!({
        "type": "object",
        "properties": { "scale": scale, "minimum": minimum },
        "additionalProperties": false,
    });
    let properties: serde_json::Map<_, _> = Modality::ALL
        .iter()
        .map(|modality| (modality.name().to_owned(), section.clone().to_value()))
        .collect();
    json_schema!({ "type": "object", "properties": properties, "additionalProperties": false })
}
