//! Plans the runs that would decide undecided claims: how many more datasets or seeds, their duration and the commands.

use super::{Claim, Each, Judgment, Values, Verdict};
use harness_analysis::{Analysis, LEVEL, Run};
use harness_registry::quoted;
use harness_spec::{Origin, Scenario};
use std::collections::{BTreeMap, BTreeSet};

/// What is added to decide a claim.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum More {
    /// Datasets, with runs for all seeds that there are.
    Datasets,
    /// Seeds on the dataset that there is.
    Seeds,
}

impl More {
    /// The number in words, such as `1 more seed` or `2 more datasets`.
    pub fn counted(self, count: usize) -> String {
        let one = match self {
            Self::Datasets => "dataset",
            Self::Seeds => "seed",
        };
        format!("{count} more {one}{}", if count == 1 { "" } else { "s" })
    }

    /// The seed of a value, or of a run, that more of these have: of `(seed of the dataset, seed of the run)`.
    fn seed_of(self, (dataset, run): (u64, i64)) -> u64 {
        match self {
            Self::Datasets => dataset,
            Self::Seeds => run as u64,
        }
    }
}

/// Runs that would decide claims, if means and standard deviations do not change.
#[derive(Debug)]
pub struct Step<'a> {
    /// Whether datasets or seeds are added.
    pub more: More,
    /// Number of datasets or seeds that there are.
    pub there: usize,
    /// Number of datasets or seeds to add.
    pub count: usize,
    /// Number of runs to add.
    pub runs: usize,
    /// Estimated duration of the runs in seconds, from the existing runs of the same cells.
    pub seconds: f64,
    /// A shell command for the runs of each experiment. It is left out if there is no spec of the experiment's name.
    pub commands: Vec<String>,
    /// The claims that the runs would decide.
    pub decides: Vec<(&'a Claim, Option<Scenario>)>,
}

/// The steps that would decide the undecided claims.
#[derive(Default)]
pub struct Plan<'a> {
    /// The steps, sorted by duration.
    pub steps: Vec<Step<'a>>,
    /// Claims that would stay undecided with [`Plan::MOST`] datasets or seeds.
    pub out_of_reach: Vec<(&'a Claim, Option<Scenario>)>,
    /// Claims with a value for each episode of one dataset. A dataset of more or longer episodes may decide them.
    pub by_episode: Vec<(&'a Claim, Option<Scenario>)>,
}

impl Plan<'_> {
    /// The maximum total number of datasets or seeds that a step may need.
    pub const MOST: usize = 100;
}

/// Plans steps for those judgments that are undecided.
pub fn plan<'a>(analysis: &Analysis, judgments: &[Judgment<'a>], quick: bool) -> Plan<'a> {
    let mut plan = Plan::default();
    let mut steps: BTreeMap<_, Step<'a>> = BTreeMap::new();
    for judgment in judgments {
        let of = (judgment.claim, judgment.scenario);
        if !matches!(judgment.verdict(), Verdict::Undecided | Verdict::OneValue { .. }) {
            continue;
        }
        if judgment.measured.each == Each::Episode && judgment.measured.datasets() == 1 {
            plan.by_episode.push(of);
            continue;
        }
        match step(analysis, judgment, quick) {
            Some(step) => {
                let scenario = judgment.scenario.map(Scenario::name);
                let same = (&judgment.claim.experiments, scenario, step.more, step.count);
                steps.entry(same).or_insert(step).decides.push(of);
            }
            None => plan.out_of_reach.push(of),
        }
    }
    plan.steps = steps.into_values().collect();
    plan.steps.sort_by(|a, b| a.seconds.total_cmp(&b.seconds));
    plan
}

/// The step that would decide a judgment. `None` if it would need more than [`Plan::MOST`] datasets or seeds.
fn step<'a>(analysis: &Analysis, judgment: &Judgment, quick: bool) -> Option<Step<'a>> {
    let estimate = judgment.measured.estimate()?;
    let there = estimate.count();
    let needed = match there {
        // A single value has no standard deviation. Two values have an interval.
        1 => 2,
        _ => estimate.needed(judgment.claim.condition.bound(), LEVEL, Plan::MOST)?.max(there + 1),
    };
    let count = needed - there;
    let has_datasets = judgment.measured.each == Each::Dataset || judgment.measured.datasets() > 1;
    let more = if has_datasets { More::Datasets } else { More::Seeds };
    let claim = judgment.claim;
    let experiments: Vec<Existing> = claim
        .experiments(quick)
        .iter()
        .map(|experiment| {
            let own =
                |run: &&Run| judgment.scenario.is_none_or(|of| run.record.spec.scenario == Origin::from(of));
            Existing::of(analysis.runs(experiment).iter().filter(own).collect(), more)
        })
        .collect();
    let seeds = |values: &Values| values.keys().map(|key| more.seed_of(*key)).collect::<BTreeSet<u64>>();
    let measured = judgment.measured.groups().map(seeds).reduce(|a, b| &a & &b).unwrap_or_default();
    let added = to_add(&experiments, &measured, count);
    let (mut runs, mut seconds, mut commands) = (0, 0.0, Vec::new());
    for (name, existing) in claim.experiments.iter().zip(experiments) {
        let lacking: Vec<u64> = added.iter().copied().filter(|seed| existing.lacks(*seed) > 0).collect();
        if lacking.is_empty() {
            continue;
        }
        let new: usize = lacking.iter().map(|seed| existing.lacks(*seed)).sum();
        runs += new;
        seconds += new as f64 * existing.seconds(more);
        commands.extend(existing.commands(analysis, (name, quick), judgment.scenario, more, &lacking));
    }
    Some(Step { more, there, count, runs, seconds, commands, decides: Vec::new() })
}

/// The seeds to add, so that every experiment has runs with `count` more seeds: first those that some experiments have
/// already, which need the fewest runs. The seeds of `measured` values add none.
fn to_add(experiments: &[Existing], measured: &BTreeSet<u64>, count: usize) -> Vec<u64> {
    let lacking = |seed: u64| experiments.iter().map(|existing| existing.lacks(seed)).sum::<usize>();
    let there: BTreeSet<u64> =
        experiments.iter().flat_map(|existing| existing.by_seed.keys().copied()).collect();
    let mut partly: Vec<u64> =
        there.iter().copied().filter(|seed| !measured.contains(seed) && lacking(*seed) > 0).collect();
    partly.sort_by_key(|seed| (lacking(*seed), *seed));
    let new = (0..).filter(|seed| !there.contains(seed) && !measured.contains(seed));
    partly.into_iter().chain(new).take(count).collect()
}

/// The runs of an experiment.
struct Existing<'a> {
    runs: Vec<&'a Run>,
    /// The number of runs with each seed, of the runs or of their datasets.
    by_seed: BTreeMap<u64, usize>,
}

impl<'a> Existing<'a> {
    fn of(runs: Vec<&'a Run>, more: More) -> Self {
        let mut by_seed = BTreeMap::new();
        for run in &runs {
            let spec = &run.record.spec;
            *by_seed.entry(more.seed_of((spec.dataset_seed(), spec.seed as i64))).or_default() += 1;
        }
        Self { runs, by_seed }
    }

    /// The number of runs with a seed that are missing: on average, the others have as many.
    fn lacks(&self, seed: u64) -> usize {
        let there = self.by_seed.get(&seed).copied().unwrap_or_default();
        self.runs.len().div_ceil(self.by_seed.len().max(1)).saturating_sub(there)
    }

    /// The duration of one more run, in seconds: the average of the existing runs.
    fn seconds(&self, more: More) -> f64 {
        let seconds = |run: &&Run| {
            run.record.timings.map_or(0.0, |timings| {
                timings.prediction + timings.reconstruction.unwrap_or_default() + timings.evaluation
            })
        };
        let trained: f64 = self.runs.iter().map(seconds).sum();
        // Each run on a dataset records the time of collecting it. It is short if the dataset existed before.
        let mut collected: BTreeMap<&str, f64> = BTreeMap::new();
        for run in self.runs.iter().filter(|_| more == More::Datasets) {
            let longest = collected.entry(&run.record.dataset).or_default();
            *longest = longest.max(run.record.timings.map_or(0.0, |timings| timings.collect));
        }
        (trained + collected.values().sum::<f64>()) / self.runs.len().max(1) as f64
    }

    /// The commands that make runs with these seeds, or with datasets of these seeds, of an experiment (its name, and
    /// whether its runs are quick).
    fn commands(
        &self,
        analysis: &Analysis,
        (name, quick): (&str, bool),
        scenario: Option<Scenario>,
        more: More,
        seeds: &[u64],
    ) -> BTreeSet<String> {
        let join =
            |seeds: &[u64], between| seeds.iter().map(u64::to_string).collect::<Vec<_>>().join(between);
        if more == More::Seeds {
            let varied = [("seeds", format!("[{}]", join(seeds, ",")))];
            return analysis.commands_like(name, quick, scenario, &varied);
        }
        let of_runs: BTreeSet<u64> = self.runs.iter().map(|run| run.record.spec.seed).collect();
        let of_runs = format!("[{}]", join(&of_runs.into_iter().collect::<Vec<_>>(), ","));
        // Any seed stands for the variable of the loop until the words are quoted.
        let varied = [("seeds", of_runs), ("simulation.seed", "0".into())];
        let commands = analysis.commands_like(name, quick, scenario, &varied).into_iter();
        let each = |run: String| {
            let run = run.replacen(&quoted(["simulation.seed=0"]), "simulation.seed=$seed", 1);
            format!("for seed in {}; do {run}; done", join(seeds, " "))
        };
        commands.map(each).collect()
    }
}
