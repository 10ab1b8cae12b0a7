//! Narrows the overrides of an experiment to one of its runs.

use super::cells::{DATASET_SEED, named};
use super::origin::Origin;
use super::run::RunSpec;
use super::schema::WITHOUT;
use super::vary::{self, FOLD};
use crate::yaml::parse;
use serde_json::{Value as Json, json};

impl RunSpec {
    /// Narrows an override (`KEY=VALUE`) of the experiment to this run: `seeds=[0,1,2]` becomes `seeds=[1]` for a run
    /// with seed 1. Overrides of other settings, and texts that are not overrides, are returned unchanged.
    pub fn own_override(&self, text: &str) -> String {
        let Some((key, value)) = text.split_once('=') else { return text.to_owned() };
        match key.trim() {
            "seeds" => format!("seeds=[{}]", self.seed),
            "latent" => self.latent().map_or(text.to_owned(), |latent| format!("latent=[{latent}]")),
            "scenarios" => {
                self.own_scenario(value).unwrap_or_else(|| format!("scenarios=[{}]", self.scenario))
            }
            "vary" => self.own_variant(value).unwrap_or_else(|| text.to_owned()),
            _ => text.to_owned(),
        }
    }

    /// Returns the override of `scenarios` with only this run's scenario; a world file is given by its path.
    fn own_scenario(&self, given: &str) -> Option<String> {
        let all: Vec<Origin> =
            serde_yaml::from_str(given).or_else(|_| serde_yaml::from_str(given).map(|one| vec![one])).ok()?;
        let own = all.into_iter().find(|origin| origin.name() == self.scenario.name())?;
        Some(format!("scenarios=[{}]", String::from(own)))
    }

    /// Returns the override of `vary` with only this run's values and labels.
    fn own_variant(&self, given: &str) -> Option<String> {
        let mut given = parse(given).ok()?;
        let mut axes = Vec::new();
        vary::axes(Some(&mut given), None).ok()?;
        for (key, axis) in given.to_json().as_object()? {
            let is_own = |name: String| self.variant.split(',').any(|own| own == name);
            let is_own_value = |value: &Json| match key.as_str() {
                DATASET_SEED | FOLD => value.as_u64() == Some(self.dataset_seed()),
                _ => is_own(named(key, value)),
            };
            let own = match axis {
                Json::Object(labels) if !labels.contains_key(WITHOUT[0]) => {
                    let (label, settings) =
                        labels.iter().find(|(label, _)| is_own(format!("{key}={label}")))?;
                    json!({ label: settings })
                }
                Json::Object(_) => json!([self.varied_input()?]),
                Json::Array(values) => json!([values.iter().find(|value| is_own_value(value))?]),
                _ => return None,
            };
            axes.push((key.clone(), own));
        }
        Some(format!("vary={}", Json::Object(axes.into_iter().collect())))
    }

    /// Returns the input that the run's variant names, in the order of the spec.
    fn varied_input(&self) -> Option<Vec<&str>> {
        let input = self.variant.split(',').find_map(|part| part.strip_prefix("input="))?;
        Some(input.split('+').collect())
    }
}
