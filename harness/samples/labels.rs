//! The labels of episodes, and the parts that follow from them.

use harness_spec::{Division, Part, Split};
use std::collections::BTreeMap;

/// What is known about the episodes of a recording besides their samples.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Labels {
    /// The labels of each episode by name; none for a simulated dataset.
    pub episodes: Vec<BTreeMap<String, Option<String>>>,
    /// The split of runs that ask for no other one; `None` for datasets that were imported before they had one.
    pub split: Option<Split>,
}

impl Labels {
    /// Returns the split that a run asks for, with what the dataset says where it asks for the default.
    pub fn split(&self, asked: &Split) -> Split {
        self.split.as_ref().map_or_else(|| asked.clone(), |own| asked.with_defaults_of(own))
    }

    /// Returns the value of a label in each episode. By episode, it is the episode's number.
    ///
    /// # Errors
    /// When an episode lacks the label. Returns the message.
    pub fn values(&self, by: Division, episodes: usize) -> Result<Vec<String>, String> {
        let Division::Label(label) = by else {
            return Ok((0..episodes).map(|episode| episode.to_string()).collect());
        };
        if !self.episodes.iter().any(|labels| labels.contains_key(label)) {
            let names: Vec<&str> =
                self.episodes.first().into_iter().flat_map(BTreeMap::keys).map(String::as_str).collect();
            return Err(match names.is_empty() {
                true => format!(
                    "split.by: there is no label '{label}'; import the dataset again, which adds labels"
                ),
                false => {
                    format!("split.by: there is no label '{label}'; the labels are {}", names.join(", "))
                }
            });
        }
        let value = |(episode, labels): (usize, &BTreeMap<String, Option<String>>)| {
            let value = labels.get(label).cloned().flatten();
            value.ok_or_else(|| format!("split.by: episode {episode} has no value of the label '{label}'"))
        };
        self.episodes.iter().enumerate().map(value).collect()
    }

    /// Returns the part of each episode in a split that keeps them whole, given their numbers of samples. None is for
    /// the test if it has a dataset of its own.
    ///
    /// # Errors
    /// When the episodes can't be divided so. Returns the message.
    pub fn parts(&self, split: &Split, samples: &[usize], has_own_test: bool) -> Result<Vec<Part>, String> {
        if split.by == Division::Episode && !split.has_groups() {
            let counts = split.counts(samples.len(), has_own_test).ok_or("there are too few episodes")?;
            let parts = [(Part::Training, counts.training), (Part::Validation, counts.validation)];
            let before_test = parts.into_iter().flat_map(|(part, count)| std::iter::repeat_n(part, count));
            return Ok(before_test.chain(std::iter::repeat(Part::Test)).take(samples.len()).collect());
        }
        let values = self.values(split.by, samples.len())?;
        let mut groups: Vec<(&str, usize)> = Vec::new();
        for (value, samples) in values.iter().zip(samples) {
            match groups.iter_mut().find(|(name, _)| name == value) {
                Some((_, all)) => *all += samples,
                None => groups.push((value.as_str(), *samples)),
            }
        }
        let number = |(name, _): &(&str, usize)| name.parse::<i64>().ok();
        let are_numbers = groups.iter().all(|group| number(group).is_some());
        groups.sort_by_key(|group| (number(group).filter(|_| are_numbers), group.0));
        let parts = split.parts(&groups)?;
        let place = |value: &String| groups.iter().position(|(name, _)| name == value).unwrap_or_default();
        Ok(values.iter().map(|value| parts[place(value)]).collect())
    }
}
