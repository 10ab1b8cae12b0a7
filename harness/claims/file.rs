//! Reads a YAML file of claims.

use super::Claim;
use harness_spec::{BuiltIn, SpecError, find};
use serde_yaml::{Location, MessageFormatter, UserMessageFormatter};
use std::path::Path;

/// The paper's claims, `experiments/claims.yaml`.
const CLAIMS: BuiltIn = BuiltIn { name: "claims", text: include_str!("../../experiments/claims.yaml") };

/// Reads and checks the claims of a file. The name `claims` stands for the paper's claims, as [`find`] says.
///
/// # Errors
/// When the file can't be read or is invalid. The error names the first problem with its file, line and column.
pub fn load(path: &Path) -> Result<Vec<Claim>, SpecError> {
    let source = find("file of claims", path, &[CLAIMS])?;
    let invalid = |location: Option<Location>, message: String| {
        let known = location.filter(|location| *location != Location::UNKNOWN);
        let (line, column) = known.map_or((1, 1), |location| (location.line(), location.column()));
        SpecError::Invalid { path: source.label.clone(), line, column, message }
    };
    let options = serde_yaml::options! { with_snippet: false };
    let claims: Vec<Claim> = serde_yaml::from_str_with_options(&source.text, options).map_err(|error| {
        let message = UserMessageFormatter.format_message(error.without_snippet()).into_owned();
        invalid(error.location(), message)
    })?;
    if claims.is_empty() {
        return Err(invalid(None, "the file holds no claims".into()));
    }
    for (index, claim) in claims.iter().enumerate() {
        if claims[..index].iter().any(|other| other.id() == claim.id()) {
            return Err(invalid(
                Some(claim.id.referenced),
                format!("there is a claim '{}' already", claim.id()),
            ));
        }
    }
    Ok(claims)
}
