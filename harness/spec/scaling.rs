//! How a modality's values are scaled for a network, and what range its predictions have.

use super::modality::Modality;
use super::types::{by_modality, names};
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize};
use std::collections::BTreeMap;
use std::fmt;

/// What a modality's values are divided by, each minus its own mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Scale {
    /// One standard deviation for all values: errors count as they do in physical units.
    Shared,
    /// Each value's own standard deviation: a value that hardly varies counts as much as any other. Not for frames.
    PerElement,
}
names!(Scale { Shared => "shared", PerElement => "per_element" });

/// How one modality is scaled and bounded.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scaling {
    pub scale: Scale,
    /// The least value of a prediction, in physical units; predictions below it are set to it.
    pub minimum: Option<f64>,
}

/// One scaling a modality.
pub type Scalings = BTreeMap<Modality, Scaling>;

/// What a spec says of how a modality is scaled; what it leaves out, the world or the dataset says.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GivenScaling {
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scale: Option<Scale>,
    /// `Some(None)` is a `null` that stands in the spec.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "present")]
    pub minimum: Option<Option<f64>>,
}

/// What a spec says of some modalities.
pub type GivenScalings = BTreeMap<Modality, GivenScaling>;

fn present<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Option<f64>>, D::Error> {
    Option::deserialize(deserializer).map(Some)
}

impl GivenScaling {
    /// With what it leaves out as in `default`.
    pub fn or(self, default: Scaling) -> Scaling {
        Scaling {
            scale: self.scale.unwrap_or(default.scale),
            minimum: self.minimum.unwrap_or(default.minimum),
        }
    }
}

impl Scaling {
    /// What a modality had before it was a setting: a vector's elements scaled one by one, and no minimum.
    pub fn plain(is_image: bool) -> Self {
        let scale = if is_image { Scale::Shared } else { Scale::PerElement };
        Self { scale, minimum: None }
    }
}

/// A section a modality, each with the keys of [`GivenScaling`].
pub(super) fn schema(generator: &mut SchemaGenerator) -> Schema {
    let scale = generator.subschema_for::<Scale>();
    let minimum = json_schema!({
        "description": "The least value of a prediction, in physical units; `null` for none.",
        "type": ["number", "null"],
    });
    by_modality(json_schema!({
        "type": "object",
        "properties": { "scale": scale, "minimum": minimum },
        "additionalProperties": false,
    }))
}
