//! What would decide the claims that are undecided: how many more datasets or seeds, for how long, by which commands.

use super::{Claim, Each, Judgement, Verdict};
use harness_analysis::{Analysis, LEVEL, Run, replicates_needed};
use harness_registry::quoted;
use harness_spec::{Origin, Scenario};
use std::collections::{BTreeMap, BTreeSet};

/// What there may be more of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum More {
    Datasets,
    Seeds,
}

impl More {
    /// `1 more seed`, `2 more datasets`.
    pub fn counted(self, count: usize) -> String {
        let one = match self {
            Self::Datasets => "dataset",
            Self::Seeds => "seed",
        };
        format!("{count} more {one}{}", if count == 1 { "" } else { "s" })
    }
}

/// Runs that would decide claims, if means and spreads stay as they are.
#[derive(Debug)]
pub struct Step<'a> {
    pub more: More,
    /// How many there are, and how many more there must be.
    pub there: usize,
    pub count: usize,
    pub runs: usize,
    /// What the runs take, by those of the same cells that there are, s.
    pub seconds: f64,
    /// Each makes the runs of one experiment; as a shell takes it.
    pub commands: Vec<String>,
    pub decides: Vec<(&'a Claim, Option<Scenario>)>,
}

/// What would decide the undecided claims.
#[derive(Default)]
pub struct Plan<'a> {
    /// The shortest first.
    pub steps: Vec<Step<'a>>,
    /// Claims that this many datasets or seeds would not decide, if means and spreads stay as they are.
    pub out_of_reach: Vec<(&'a Claim, Option<Scenario>)>,
    /// Claims by episodes, which a dataset of more or longer episodes may decide.
    pub by_episode: Vec<(&'a Claim, Option<Scenario>)>,
}

impl Plan<'_> {
    /// The most datasets or seeds that a step has.
    pub const MOST: usize = 100;
}

/// Plans for those of these judgements that are undecided.
pub fn plan<'a>(analysis: &Analysis, judgements: &[Judgement<'a>], quick: bool) -> Plan<'a> {
    let mut plan = Plan::default();
    let mut steps: BTreeMap<Vec<String>, Step<'a>> = BTreeMap::new();
    for judgement in judgements {
        let of = (judgement.claim, judgement.scenario);
        if !matches!(judgement.verdict(), Verdict::Undecided | Verdict::OneSeed { .. }) {
            continue;
        }
        if judgement.measured.each == Each::Episode {
            plan.by_episode.push(of);
            continue;
        }
        match step(analysis, judgement, quick) {
            Some(step) => steps.entry(step.commands.clone()).or_insert(step).decides.push(of),
            None => plan.out_of_reach.push(of),
        }
    }
    plan.steps = steps.into_values().collect();
    plan.steps.sort_by(|a, b| a.seconds.total_cmp(&b.seconds));
    plan
}

/// What would decide a judgement; `None` if more than [`Plan::MOST`] datasets or seeds.
fn step<'a>(analysis: &Analysis, judgement: &Judgement, quick: bool) -> Option<Step<'a>> {
    let replicates = judgement.measured.replicates();
    let there = replicates.len();
    let needed = match there {
        // A single value says nothing about the spread: with two there is an interval.
        1 => 2,
        _ => replicates_needed(&replicates, judgement.claim.condition.bound(), LEVEL, Plan::MOST)?
            .max(there + 1),
    };
    let count = needed - there;
    let more = if judgement.measured.datasets().len() > 1 { More::Datasets } else { More::Seeds };
    let (mut runs, mut seconds, mut commands) = (0, 0.0, Vec::new());
    let claim = judgement.claim;
    for (name, experiment) in claim.experiments.iter().zip(claim.experiments(quick)) {
        let own =
            |run: &&Run| judgement.scenario.is_none_or(|of| run.record.spec.scenario == Origin::from(of));
        let own: Vec<&Run> = analysis.runs(&experiment).iter().filter(own).collect();
        let an_addition = one_more(&own, more);
        runs += count * an_addition.0;
        seconds += count as f64 * an_addition.1;
        commands.push(command(&analysis.command(name, quick), judgement.scenario, &own, more, count));
    }
    Some(Step { more, there, count, runs, seconds, commands, decides: Vec::new() })
}

/// How many runs one more dataset or seed makes, and how long they take, s: as many and as long as there are for each.
fn one_more(runs: &[&Run], more: More) -> (usize, f64) {
    let seconds = |run: &Run| {
        run.record.timings.map_or(0.0, |timings| {
            timings.prediction + timings.reconstruction.unwrap_or_default() + timings.evaluation
        })
    };
    let there = seeds_of(runs, more).len().max(1);
    let trained: f64 = runs.iter().map(|run| seconds(run)).sum();
    // Runs that share a dataset repeat the time that it took, which is short where it was there before.
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
