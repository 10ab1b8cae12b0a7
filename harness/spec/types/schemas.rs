//! The schemas of settings whose type does not say what is valid.

use super::{Family, Loss, OutputSettings, Predict, TestDataset};
use crate::layout::{Layout, Modality, by_modality};
use crate::search::Search;
use schemars::{Schema, SchemaGenerator, json_schema};

pub fn factors_schema(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "type": "array", "items": { "type": "string" }, "uniqueItems": true })
}
pub fn rates_schema(_: &mut SchemaGenerator) -> Schema {
    let rate = json_schema!({ "type": "number", "minimum": 0.0, "exclusiveMaximum": 1.0 });
    json_schema!({ "type": "object", "additionalProperties": rate })
}
pub fn search_schema(generator: &mut SchemaGenerator) -> Schema {
    generator.subschema_for::<Search>()
}
pub fn test_dataset_schema(generator: &mut SchemaGenerator) -> Schema {
    generator.subschema_for::<TestDataset>()
}
/// The schema of the list alone. Without it, the schema would also allow `null`.
pub fn channels_schema(_: &mut SchemaGenerator) -> Schema {
    json_schema!({
        "type": "array", "maxItems": 16,
        "items": { "type": "integer", "minimum": 1, "maximum": 512 },
    })
}

/// The schema of one value for each modality that is a vector.
pub fn by_vector(of: Schema) -> Schema {
    let mut schema = by_modality(of).to_value();
    if let Some(properties) = schema["properties"].as_object_mut() {
        let layout = Layout::finger();
        properties.retain(|name, _| Modality::new(name).is_some_and(|modality| !layout[modality].is_image()));
    }
    schema.try_into().expect("an object with fewer properties is a schema")
}

pub fn losses_schema(generator: &mut SchemaGenerator) -> Schema {
    by_vector(generator.subschema_for::<Loss>())
}

pub fn distributions_schema(generator: &mut SchemaGenerator) -> Schema {
    by_vector(generator.subschema_for::<Family>())
}

pub fn predict_schema(generator: &mut SchemaGenerator) -> Schema {
    by_vector(generator.subschema_for::<Predict>())
}

pub fn outputs_schema(generator: &mut SchemaGenerator) -> Schema {
    by_modality(generator.subschema_for::<OutputSettings>())
}

pub fn weight_schema(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "type": "number", "minimum": 0.0, "maximum": 1e6 })
}

/// The schema of one weight for each modality.
pub fn loss_weights_schema(generator: &mut SchemaGenerator) -> Schema {
    by_modality(weight_schema(generator))
}
