//! The scaling of a modality's values for a network, and the lower bound of its predictions.

use super::modality::{Modality, Scale, by_modality};
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize};
use std::borrow::Cow;
use std::collections::BTreeMap;

/// The scaling and the lower bound of one modality.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scaling {
    /// The standard deviation by which the values are divided.
    pub scale: Scale,
    /// The lowest value of a prediction, in physical units. Lower predictions are set to it. `None` means no bound.
    pub minimum: Option<f64>,
}

/// The scaling of each modality.
pub type Scalings = BTreeMap<Modality, Scaling>;

/// The scaling of a modality as given in a spec. Values that are left out come from the world or the dataset.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GivenScaling {
    /// The standard deviation by which the values are divided; `None` if the spec does not say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scale: Option<Scale>,
    /// The lowest value of a prediction, in physical units. `None` if the spec does not say; `Some(None)` if the spec
    /// has `null`, which means no bound.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "present")]
    pub minimum: Option<Option<f64>>,
}

/// The scaling of modalities as given in a spec.
pub type GivenScalings = BTreeMap<Modality, GivenScaling>;

/// Reads a key that is there: `Some(None)` for `null`. A key that may be missing also has `#[serde(default)]`.
///
/// # Errors
/// When the value is neither a number nor `null`.
pub fn present<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Option<f64>>, D::Error> {
    Option::deserialize(deserializer).map(Some)
}

impl GivenScaling {
    /// Fills in the values that are left out with those of `default`.
    pub fn or(self, default: Scaling) -> Scaling {
        Scaling {
            scale: self.scale.unwrap_or(default.scale),
            minimum: self.minimum.unwrap_or(default.minimum),
        }
    }
}

impl Scaling {
    /// Returns the scaling that was in use before it became a setting: an image has one scale, each element of a vector
    /// has its own, and there is no minimum.
    pub fn plain(is_image: bool) -> Self {
        let scale = if is_image { Scale::Shared } else { Scale::PerElement };
        Self { scale, minimum: None }
    }
}

impl JsonSchema for GivenScaling {
    fn schema_name() -> Cow<'static, str> {
        "Scaling".into()
    }

    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        let minimum = json_schema!({
            "description": "The lowest value of a prediction, in physical units. `null` means no bound.",
            "type": ["number", "null"],
        });
        json_schema!({
            "type": "object",
            "properties": { "scale": generator.subschema_for::<Scale>(), "minimum": minimum },
            "additionalProperties": false,
        })
    }
}

/// The JSON schema of [`GivenScalings`]: one section for each modality.
pub fn scalings_schema(generator: &mut SchemaGenerator) -> Schema {
    by_modality(generator.subschema_for::<GivenScaling>())
}
