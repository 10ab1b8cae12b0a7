//! Reads a YAML file of claims.

use super::Claim;
use super::metric::ClaimMetric;
use harness_registry::Registry;
use harness_spec::{BuiltIn, Experiment, SpecError, find, is_name};
use harness_sql::Query;
use harness_tables::schema::Table;
use serde::Deserialize;
use serde::de::{DeserializeOwned, IgnoredAny};
use serde_yaml::{Location, MessageFormatter, Spanned, UserMessageFormatter};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// A file of claims.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClaimsFile {
    /// A spec with readings. If it has runs, the claims are judged by them, beside the claims' own experiments.
    #[serde(default)]
    pub readings: Option<PathBuf>,
    /// Queries by name. The queries of claims, and these queries themselves, can read a name as a table.
    #[serde(default, rename = "with")]
    pub definitions: BTreeMap<String, Spanned<String>>,
    /// The claims, in the order of the file.
    pub claims: Vec<Claim>,
}

impl ClaimsFile {
    /// The spec of [`Self::readings`], if it has runs. With `quick`, it is about the quick runs.
    ///
    /// # Errors
    /// When the spec can't be read or is invalid.
    pub fn spec_of_readings(
        &self,
        registry: &Registry,
        quick: bool,
    ) -> Result<Option<Experiment>, SpecError> {
        let Some(path) = &self.readings else { return Ok(None) };
        let spec = harness_spec::load(path, &[], quick)?;
        Ok(registry.has_runs(&spec.name).then_some(spec))
    }
}

/// The paper's claims, `experiments/claims.yaml`.
const CLAIMS: BuiltIn = BuiltIn { name: "claims", text: include_str!("../../experiments/claims.yaml") };

/// The message for YAML that is something else, such as a spec.
const NO_CLAIMS: &str = "this is not a file of claims, which is a list, or a map with the key `claims`; each claim in \
                         it has at least the keys id, statement, measured, experiments, query and condition";

/// Reads and checks a file of claims: a list of claims, or a map with the keys of [`ClaimsFile`]. The name `claims`
/// stands for the paper's claims, as [`find`] says.
///
/// # Errors
/// When the file can't be read or is invalid. The error names the first problem with its file, line and column.
pub fn load(path: &Path) -> Result<ClaimsFile, SpecError> {
    let source = find("file of claims", path, &[CLAIMS])?;
    let invalid = |location: Option<Location>, message: String| {
        let known = location.filter(|location| *location != Location::UNKNOWN);
        let (line, column) = known.map_or((1, 1), |location| (location.line(), location.column()));
        SpecError::Invalid { path: source.label.clone(), line, column, message }
    };
    let has_keys =
        parse::<BTreeMap<String, IgnoredAny>>(&source.text).is_ok_and(|keys| keys.contains_key("claims"));
    let parsed = match has_keys {
        true => parse(&source.text),
        false => parse(&source.text).map(|claims| ClaimsFile {
            readings: None,
            definitions: BTreeMap::new(),
            claims,
        }),
    };
    let mut file: ClaimsFile = parsed.map_err(|error| {
        if let Err(broken) = parse::<IgnoredAny>(&source.text) {
            return invalid(broken.location(), format!("broken YAML: {}", told(&broken)));
        }
        match parse::<Vec<BTreeMap<String, IgnoredAny>>>(&source.text) {
            Err(other) if !has_keys => invalid(other.location(), NO_CLAIMS.to_owned()),
            _ => invalid(error.location(), told(&error)),
        }
    })?;
    let claims = &mut file.claims;
    if claims.is_empty() {
        return Err(invalid(None, "the file contains no claims".into()));
    }
    for (name, query) in &file.definitions {
        fault_of_definition(name, &query.value)
            .map_or(Ok(()), |message| Err(invalid(Some(query.defined), message)))?;
    }
    for claim in claims.iter_mut() {
        claim.insert(&file.definitions);
    }
    for (index, claim) in claims.iter().enumerate() {
        if claims[..index].iter().any(|other| other.id() == claim.id()) {
            return Err(invalid(
                Some(claim.id.referenced),
                format!("there is a claim '{}' already", claim.id()),
            ));
        }
        if claim.difference.is_some() && !claim.scenarios.is_empty() {
            let message = format!(
                "the claim '{}' has scenarios and a difference; leave out `scenarios`, which are judged one by one",
                claim.id()
            );
            return Err(invalid(Some(claim.id.referenced), message));
        }
        if let Some((location, message)) = fault_of_metric(claim) {
            return Err(invalid(Some(location), message));
        }
    }
    for claim in claims {
        claim.insert_metric();
        claim.file.clone_from(&source.label);
    }
    Ok(file)
}

/// What is wrong with a query under `with`, or with its name. A query with placeholders is checked in the claims that
/// read it.
fn fault_of_definition(name: &str, query: &str) -> Option<String> {
    if !is_name(name) {
        return Some(format!(
            "'{name}' under `with` is no name of a query; use lower-case letters, digits and '_', a letter first"
        ));
    }
    if Table::ALL.iter().any(|table| table.name() == name) {
        return Some(format!(
            "there is a table '{name}', which a query under `with` would hide; use another name"
        ));
    }
    let fault = Query::parse(query).err().filter(|_| !query.contains('{'))?;
    Some(format!("the query '{name}' under `with`: {fault}"))
}

/// Puts those definitions before a query whose names it contains, and those whose names these contain.
pub(super) fn with_definitions(query: &str, definitions: &BTreeMap<String, Spanned<String>>) -> String {
    let mut used = Vec::new();
    add_used(query, definitions, &mut BTreeSet::new(), &mut used);
    if used.is_empty() {
        return query.to_owned();
    }
    let of =
        |name: &&str| format!("{name} as (\n{}\n)", definitions[*name].value.trim().trim_end_matches(';'));
    let list: Vec<String> = used.iter().map(of).collect();
    let own = after_with(query).map_or(format!("\n{query}"), |own| format!(", {}", own.trim_start()));
    format!("with {}{own}", list.join(", "))
}

/// Adds the names of definitions that a query contains, each after those that its own query contains.
fn add_used<'a>(
    query: &str,
    definitions: &'a BTreeMap<String, Spanned<String>>,
    seen: &mut BTreeSet<&'a str>,
    used: &mut Vec<&'a str>,
) {
    for (name, sql) in definitions {
        if words(query).any(|word| word.eq_ignore_ascii_case(name)) && seen.insert(name) {
            add_used(&sql.value, definitions, seen, used);
            used.push(name);
        }
    }
}

/// The words of a query that stand outside of texts.
fn words(query: &str) -> impl Iterator<Item = &str> {
    let outside = query.split('\'').step_by(2);
    outside.flat_map(|part| part.split(|letter: char| !letter.is_alphanumeric() && letter != '_'))
}

/// What stands after WITH at the beginning of a query; `None` if it begins otherwise.
fn after_with(query: &str) -> Option<&str> {
    let mut rest = query.trim_start();
    while rest.starts_with("--") {
        rest = rest.split_once('\n')?.1.trim_start();
    }
    let (first, rest) = rest.split_at_checked("with".len())?;
    (first.eq_ignore_ascii_case("with") && rest.starts_with(char::is_whitespace)).then_some(rest)
}

/// The place and the message of a fault, if the queries of a claim do not match its metric.
fn fault_of_metric(claim: &Claim) -> Option<(Location, String)> {
    let id = claim.id();
    let Some(metric) = &claim.metric else {
        let of = |query: &Spanned<String>| Some((query.defined, ClaimMetric::place_in(&query.value)?));
        let (location, place) = claim.queries().find_map(of)?;
        let message = format!(
            "{place} stands for the metric of the claim '{id}'; add the key `metric`, such as metric: r2"
        );
        return Some((location, message));
    };
    let required = claim.requires.as_ref().map(|requirement| &requirement.query);
    let lacking = required.filter(|query| !query.value.contains(ClaimMetric::NAME));
    let is_used = claim.queries().any(|query| query.value.contains(ClaimMetric::NAME));
    match lacking {
        Some(query) => Some((
            query.defined,
            format!(
                "the claim '{id}' has a metric, so its requirement must be in it; write metric = '{{metric}}'"
            ),
        )),
        None if !is_used => Some((
            metric.referenced,
            format!("no query of the claim '{id}' contains {{metric}}; write metric = '{{metric}}'"),
        )),
        None => None,
    }
}

fn parse<T: DeserializeOwned>(text: &str) -> Result<T, serde_yaml::Error> {
    serde_yaml::from_str_with_options(text, serde_yaml::options! { with_snippet: false })
}

fn told(error: &serde_yaml::Error) -> String {
    UserMessageFormatter.format_message(error.without_snippet()).into_owned()
}
