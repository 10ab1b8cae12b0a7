//! Values that several parts of a world file have: patterns of names, and ranges.

use schemars::{Schema, SchemaGenerator, json_schema};
use std::borrow::Borrow;

/// The schema of a list of patterns of names, which is not empty.
pub(super) fn globs(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "type": "array", "items": { "type": "string" }, "minItems": 1 })
}

/// Refuses a range whose lowest value is above its highest. The error is the message.
pub(super) fn ascending([low, high]: [f64; 2]) -> Result<(), String> {
    if low <= high {
        Ok(())
    } else {
        Err(format!("the range [{low}, {high}] is reversed; write [{high}, {low}]"))
    }
}

/// Returns the indices of the `names` that match one of the patterns, in ascending order. A pattern that is one of the
/// names matches only that name, also if it has characters such as `[`.
///
/// # Errors
/// When a pattern is invalid or matches nothing. The error has the pattern and the message.
pub fn matching<N: Borrow<str>>(patterns: &[String], names: &[N]) -> Result<Vec<usize>, (String, String)> {
    let mut found = Vec::new();
    for pattern in patterns {
        if let Some(exact) = names.iter().position(|name| name.borrow() == pattern) {
            found.push(exact);
            continue;
        }
        let glob = glob::Pattern::new(pattern).map_err(|error| (pattern.clone(), error.msg.to_owned()))?;
        let before = found.len();
        found.extend((0..names.len()).filter(|index| glob.matches(names[*index].borrow())));
        if found.len() == before {
            return Err((pattern.clone(), "matches nothing".into()));
        }
    }
    found.sort_unstable();
    found.dedup();
    Ok(found)
}
