//! What is wrong with the sensors that a network gets its inputs from.

use crate::layout::{Definition, Modality};
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;

/// What is wrong with a sensor. Targets, and the inputs of baselines that repeat or average targets, are as recorded.
///
/// Strengths of `noise`, `bias` and `drift` are standard deviations, in units of the standard deviation by which the
/// input is scaled for the network (`scaling`).
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Disturbance {
    /// Gaussian noise on each value of each sample.
    #[serde(skip_serializing_if = "is_zero")]
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub noise: f64,
    /// A shift of each element of a vector, which is drawn for each episode.
    #[serde(skip_serializing_if = "is_zero")]
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub bias: f64,
    /// A shift of each element of a vector that grows linearly from 0. This is its rate in 1 s, which is drawn for each
    /// episode.
    #[serde(skip_serializing_if = "is_zero")]
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub drift: f64,
    /// Number of samples by which values arrive late. Until then, the network gets the first one of the episode.
    #[serde(skip_serializing_if = "is_none")]
    #[schemars(range(max = 1000))]
    pub delay: usize,
    /// Probability that a sample is lost. The network then gets the one before it again.
    #[serde(skip_serializing_if = "is_zero")]
    #[schemars(range(min = 0.0, max = 1.0))]
    pub dropped: f64,
    /// Probability that an element of a vector is 0 in an episode.
    #[serde(skip_serializing_if = "is_zero")]
    #[schemars(range(min = 0.0, max = 1.0))]
    pub dead: f64,
    /// The elements of a vector that have a sensor, by the number of their column, from 0. The others are 0. Without a
    /// list, all have one.
    #[serde(skip_serializing_if = "Vec::is_empty", deserialize_with = "sorted")]
    #[schemars(length(min = 1), extend("uniqueItems" = true))]
    pub only: Vec<usize>,
    /// Part of an image that is gray: a rectangle like the image, at a place that is drawn for each episode.
    #[serde(skip_serializing_if = "is_zero")]
    #[schemars(range(min = 0.0, max = 1.0))]
    pub occlusion: f64,
    /// Standard deviation of a Gaussian blur of an image, in pixels.
    #[serde(skip_serializing_if = "is_zero")]
    #[schemars(range(min = 0.0, max = 100.0))]
    pub blur: f64,
}

/// What is wrong with the sensors of some inputs.
pub type Disturbances = BTreeMap<Modality, Disturbance>;

fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

/// Reads numbers whose order has no meaning.
fn sorted<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<usize>, D::Error> {
    let mut numbers = Vec::deserialize(from)?;
    numbers.sort_unstable();
    Ok(numbers)
}

fn is_none(count: &usize) -> bool {
    *count == 0
}

impl Disturbance {
    /// Returns the name of an input with what is wrong with its sensor: `arm`, or `arm noise=0.1 delay=2`.
    pub fn named(&self, modality: Modality) -> String {
        let settings = serde_json::to_value(self).unwrap_or_default();
        let settings = settings.as_object().into_iter().flatten();
        let settings = settings.map(|(key, value)| format!("{key}={}", in_name(value)));
        std::iter::once(modality.name().to_owned()).chain(settings).collect::<Vec<_>>().join(" ")
    }

    /// Returns the first setting that an image, or a vector, can't have.
    pub fn unsuitable(&self, is_image: bool) -> Option<&'static str> {
        let of_vectors = [
            ("bias", self.bias != 0.0),
            ("drift", self.drift != 0.0),
            ("dead", self.dead != 0.0),
            ("only", !self.only.is_empty()),
        ];
        let of_images = [("occlusion", self.occlusion != 0.0), ("blur", self.blur != 0.0)];
        let others: &[(&str, bool)] = if is_image { &of_vectors } else { &of_images };
        others.iter().find(|(_, is_set)| *is_set).map(|(key, _)| *key)
    }

    /// Returns a sentence about the first setting that a modality can't have, after its key.
    ///
    /// # Errors
    /// When there is one.
    pub(super) fn check(&self, definition: &Definition) -> Result<(), String> {
        let modality = definition.name;
        if let (true, Some(of)) = (definition.is_image(), definition.difference_of) {
            return Err(format!(
                "'{modality}' is computed from the images of '{of}'; disturb '{of}' instead, if it is an input"
            ));
        }
        if let Some(key) = self.unsuitable(definition.is_image()) {
            return Err(unsuitable(modality, key, definition.is_image()));
        }
        let width = definition.width();
        match self.only.iter().find(|element| **element >= width) {
            Some(element) => Err(format!(
                "'{modality}' has no element {element}, as 'only' says; its elements are 0 to {}",
                width - 1
            )),
            None => Ok(()),
        }
    }
}

/// A value in a name, whose parts are separated by commas: `1+3` for a list.
fn in_name(value: &Value) -> String {
    match value.as_array() {
        Some(items) => items.iter().map(Value::to_string).collect::<Vec<_>>().join("+"),
        None => value.to_string(),
    }
}

/// The message about a setting that an image, or a vector, can't have.
pub(super) fn unsuitable(modality: Modality, key: &str, is_image: bool) -> String {
    match is_image {
        true => format!(
            "'{modality}' is an image, which has no {key}; use noise, delay, dropped, occlusion or blur"
        ),
        false => format!(
            "'{modality}' is a vector, which has no {key}; use noise, bias, drift, delay, dropped, dead \
             or only"
        ),
    }
}

/// The schema of [`Disturbances`]: one section for each modality.
pub(super) fn disturbances_schema(generator: &mut SchemaGenerator) -> Schema {
    let of_one = generator.subschema_for::<Disturbance>();
    json_schema!({ "type": "object", "properties": {}, "additionalProperties": of_one })
}
