//! Plans the runs that would decide undecided claims: how many more datasets or seeds, their duration and the commands.

use super::{Claim, Each, Judgment, Verdict};
use harness_analysis::{Analysis, LEVEL, Run, replicates_needed};
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
    /// Claims with a value for each episode. A dataset of more or longer episodes may decide them.
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
        if judgment.measured.each == Each::Episode {
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
    let replicates = judgment.measured.replicates();
    let there = replicates.len();
    let needed = match there {
        // A single value has no standard deviation. Two values have an interval.
        1 => 2,
        _ => replicates_needed(&replicates, judgment.claim.condition.bound(), LEVEL, Plan::MOST)?
            .max(there + 1),
    };
    let count = needed - there;
    let has_datasets = judgment.measured.each == Each::Dataset || judgment.measured.datasets().len() > 1;
    let more = if has_datasets { More::Datasets } else { More::Seeds };
    let (mut runs, mut seconds, mut commands) = (0, 0.0, Vec::new());
    let claim = judgment.claim;
    for (name, experiment) in claim.experiments.iter().zip(claim.experiments(quick)) {
        let own =
            |run: &&Run| judgment.scenario.is_none_or(|of| run.record.spec.scenario == Origin::from(of));
        let own: Vec<&Run> = analysis.runs(&experiment).iter().filter(own).collect();
        let an_addition = one_more(&own, more);
        runs += count * an_addition.0;
        seconds += count as f64 * an_addition.1;
        let run = analysis.command(name, quick);
        commands.extend(run.map(|run| command(&run, judgment.scenario, &own, more, count)));
    }
    Some(Step { more, there, count, runs, seconds, commands, decides: Vec::new() })
}

/// The number of runs that one more dataset or seed needs, and their duration in seconds: the averages of the existing
/// datasets or seeds.
fn one_more(runs: &[&Run], more: More) -> (usize, f64) {
    let seconds = |run: &Run| {
        run.record.timings.map_or(0.0, |timings| {
            timings.prediction + timings.reconstruction.unwrap_or_default() + timings.evaluation
        })
    };
    let there = seeds_of(runs, more).len().max(1);
    let trained: f64 = runs.iter().map(|run| seconds(run)).sum();
    // Each run on a dataset records the time of collecting it. It is short if the dataset existed before.
    let mut collected: BTreeMap<&str, f64> = BTreeMap::new();
    for run in runs.iter().filter(|_| more == More::Datasets) {
        let longest = collected.entry(&run.record.dataset).or_default();
        *longest = longest.max(run.record.timings.map_or(0.0, |timings| timings.collect));
    }
    let all = trained + collected.values().sum::<f64>();
    (runs.len().div_ceil(there), all / there as f64)
}

fn seeds_of(runs: &[&Run], more: More) -> BTreeSet<u64> {
    let seed = |run: &&Run| match more {
        More::Datasets => run.record.spec.dataset_seed(),
        More::Seeds => run.record.spec.seed,
    };
    runs.iter().map(seed).collect()
}

/// The command that makes the runs of `count` more datasets or seeds than there are.
fn command(run: &str, scenario: Option<Scenario>, runs: &[&Run], more: More, count: usize) -> String {
    let there = seeds_of(runs, more);
    let new: Vec<u64> = (0..).filter(|seed| !there.contains(seed)).take(count).collect();
    let scenarios = scenario.map(|scenario| format!("scenarios=[{scenario}]"));
    let listed =
        |seeds: &[u64], between: &str| seeds.iter().map(u64::to_string).collect::<Vec<_>>().join(between);
    match more {
        More::Seeds => {
            let seeds = format!("seeds=[{}]", listed(&new, ","));
            format!("{run} {}", quoted(scenarios.as_deref().into_iter().chain([seeds.as_str()])))
        }
        More::Datasets => {
            let seeds = format!(
                "seeds=[{}]",
                listed(&seeds_of(runs, More::Seeds).into_iter().collect::<Vec<_>>(), ",")
            );
            let words = quoted(scenarios.as_deref().into_iter().chain([seeds.as_str()]));
            format!("for seed in {}; do {run} {words} simulation.seed=$seed; done", listed(&new, " "))
        }
    }
}
