//! How often the links are touched in the datasets that claims are judged on.

use harness_analysis::Analysis;
use harness_catalog::{QueryError, rows};
use harness_shared::numbers::{counted, rounded};
use harness_spec::Scenario;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::fmt;

/// The force whose contacts are counted.
const FORCE: &str = "contact_force";
/// In the scenario `cluttered`, boxes are out of reach if the links before the distal quarter have fewer contacts per
/// sample. The ground alone gives 0.003.
const REACHED: f64 = 0.05;

/// The contacts in the datasets of an experiment's runs in one scenario.
#[derive(Debug, Clone, PartialEq)]
pub struct Contacts {
    /// The reading, or the experiment if it has no readings.
    pub runs: String,
    /// The scenario.
    pub scenario: String,
    /// Number of datasets.
    pub datasets: usize,
    /// Number of links before the distal quarter.
    pub inner_links: usize,
    /// Contacts per sample on all links: the mean over the datasets.
    pub all: f64,
    /// Contacts per sample on the links before the distal quarter: the mean over the datasets.
    pub inner: f64,
}

impl Contacts {
    /// Whether this is the scenario with boxes, and the arm hardly reaches them.
    pub fn lacks_boxes(&self) -> bool {
        self.scenario == Scenario::CLUTTERED.name() && self.inner < REACHED
    }
}

impl fmt::Display for Contacts {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let Self { runs, scenario, inner_links, .. } = self;
        let (all, inner) = (rounded(self.all), rounded(self.inner));
        let datasets = counted(self.datasets, "dataset");
        write!(f, "{runs}, {scenario}, {datasets}: {all} contacts per sample")?;
        write!(f, ", {inner} on links 0 to {}", inner_links.saturating_sub(1))?;
        if self.lacks_boxes() { write!(f, ": boxes out of reach") } else { Ok(()) }
    }
}

/// A link in a dataset.
#[derive(Deserialize)]
struct Link {
    runs: String,
    scenario: String,
    dataset: String,
    index: usize,
    touched: f64,
}

/// Returns the contacts in the datasets of the runs of these experiments, one for each reading or experiment and each
/// scenario. Datasets without the force `contact_force` have none.
///
/// # Errors
/// When a table is damaged.
pub fn contacts(analysis: &Analysis, experiments: &[&str]) -> Result<Vec<Contacts>, QueryError> {
    let sql = format!(
        "select coalesce(reading, experiment) as runs, scenario, dataset, index,
           max(contacts) * 1.0 / max(samples) as touched
         from forces join runs using (experiment, run, scenario)
         where episode is null and modality = '{FORCE}'
         group by coalesce(reading, experiment), scenario, dataset, index
         order by runs, scenario desc, dataset, index"
    );
    let links: Vec<Link> = rows(&mut analysis.query(experiments, &sql)?)?;
    let mut found: BTreeMap<(&str, &str), Vec<&[Link]>> = BTreeMap::new();
    for dataset in
        links.chunk_by(|a, b| (&a.runs, &a.scenario, &a.dataset) == (&b.runs, &b.scenario, &b.dataset))
    {
        found.entry((&dataset[0].runs, &dataset[0].scenario)).or_default().push(dataset);
    }
    let of = |((runs, scenario), datasets): ((&str, &str), Vec<&[Link]>)| {
        let links = datasets[0].len();
        let inner_links = links - links / 4;
        let mean = |limit: usize| {
            let touched = |dataset: &&[Link]| -> f64 {
                dataset.iter().filter(|link| link.index < limit).map(|link| link.touched).sum()
            };
            datasets.iter().map(touched).sum::<f64>() / datasets.len() as f64
        };
        Contacts {
            runs: runs.to_owned(),
            scenario: scenario.to_owned(),
            datasets: datasets.len(),
            inner_links,
            all: mean(links),
            inner: mean(inner_links),
        }
    };
    Ok(found.into_iter().map(of).collect())
}
