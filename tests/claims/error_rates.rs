//! The rates of wrong verdicts on simulated values whose truth is known: with effects of the dataset and of the seed,
//! and rounded values, so that some are equal.

use super::{file, load};
use harness::claims::{Claim, Each, Judgment, Measured, Values, Verdict};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const DRAWS: usize = 2000;

/// The promised rate of each of the two wrong verdicts: half of what a 95 % interval leaves out.
const PROMISED: f64 = 0.025;

/// The numbers of datasets, and of seeds or episodes on each.
const SIZES: [(u64, i64); 4] = [(6, 1), (3, 2), (6, 3), (1, 5)];

/// A claim of each kind.
const KINDS: &str = "
- {id: comparison, statement: s, measured: m, experiments: [e], query: q, condition: above 0}
- {id: threshold, statement: s, measured: m, experiments: [e], query: q, condition: below 0.5}
- {id: margin, statement: s, measured: m, experiments: [e], query: q, condition: below margin 0.1}
- {id: difference, statement: s, measured: m, experiments: [e], query: q, condition: above 0, difference: [cluttered, \
empty]}
- {id: required, statement: s, measured: m, experiments: [e], query: q, condition: above 0,
   requires: {measured: m, query: q, condition: below 0.95}}
";

/// Values of datasets and seeds around a true mean. Values of one dataset have no effect of the dataset, because their
/// interval is about that dataset.
struct Table {
    sizes: (u64, i64),
    of_datasets: f64,
    of_seeds: f64,
}

impl Table {
    fn draw(&self, random: &mut ChaCha8Rng, truth: f64) -> Values {
        let (datasets, seeds) = self.sizes;
        let mut normal = || random.sample::<f64, _>(rand_distr::StandardNormal);
        let mut values = Values::new();
        for dataset in 0..datasets {
            let middle = if datasets > 1 { self.of_datasets * normal() } else { 0.0 };
            for seed in 0..seeds {
                let deviation = middle + self.of_seeds * normal();
                // A quarter of a deviation of the seeds is the smallest step, so some values are equal.
                let step = 0.25 * self.of_seeds;
                values.insert((dataset, seed), truth + step * (deviation / step).round());
            }
        }
        values
    }
}

fn measured(values: Values, minus: Option<Values>) -> Measured {
    Measured { each: Each::Seed, values, minus }
}

/// The shares of the verdicts "holds" and "does not hold".
fn rates(judge: impl FnMut() -> Verdict) -> (f64, f64) {
    let verdicts: Vec<Verdict> = std::iter::repeat_with(judge).take(DRAWS).collect();
    let share = |of: Verdict| verdicts.iter().filter(|one| **one == of).count() as f64 / DRAWS as f64;
    (share(Verdict::Holds), share(Verdict::DoesNotHold))
}

/// The verdicts on a claim whose value is `truth`, and whose requirement has the value `required`.
fn verdicts(claim: &Claim, table: &Table, truth: f64, required: f64) -> (f64, f64) {
    let mut random = ChaCha8Rng::seed_from_u64(table.sizes.0 * 100 + table.sizes.1 as u64);
    rates(|| {
        // The scenarios of a difference share a large mean.
        let shared = if claim.difference.is_some() { 3.0 } else { 0.0 };
        let values = table.draw(&mut random, shared + truth);
        let minus = claim.difference.map(|_| table.draw(&mut random, shared));
        let needed = claim.requires.as_ref().map(|_| measured(table.draw(&mut random, required), None));
        let measured = measured(values, minus);
        Judgment { claim, scenario: None, measured, required: needed, mixed: Vec::new() }.verdict()
    })
}

/// Asserts that a rate of errors is at most the promised rate, up to four standard deviations of its estimate.
#[track_caller]
fn assert_rare(rate: f64, what: &str) {
    let most = PROMISED + 4.0 * (PROMISED * (1.0 - PROMISED) / DRAWS as f64).sqrt();
    assert!(rate <= most, "{what}: {rate}");
}

#[test]
fn verdicts_of_each_kind_are_wrong_as_rarely_as_promised() {
    let (_folder, path) = file(KINDS);
    for claim in &load(&path).unwrap().claims {
        let (bound, learned) = (claim.condition.bound(), 0.5);
        let better = if claim.condition.satisfied_by(bound + 1.0) { 1.0 } else { -1.0 };
        for sizes in SIZES {
            for of_datasets in [0.0, 0.05, 0.2] {
                let table = Table { sizes, of_datasets, of_seeds: 0.05 };
                let what = format!("{} {sizes:?} {of_datasets}", claim.id());
                // At the bound, both decided verdicts are wrong. On one of its sides, one of them is.
                let (holds, fails) = verdicts(claim, &table, bound, learned);
                assert_rare(holds, &what);
                assert_rare(fails, &what);
                assert_rare(verdicts(claim, &table, bound - 0.03 * better, learned).0, &what);
                assert_rare(verdicts(claim, &table, bound + 0.03 * better, learned).1, &what);
            }
            // Where the truth is far from the bound, most verdicts are decided.
            let table = Table { sizes, of_datasets: 0.05, of_seeds: 0.05 };
            let (holds, fails) = verdicts(claim, &table, bound + better, learned);
            assert!(holds > 0.95 && fails == 0.0, "{} {sizes:?}: {holds} {fails}", claim.id());
            let (holds, fails) = verdicts(claim, &table, bound - better, learned);
            assert!(fails > 0.95 && holds == 0.0, "{} {sizes:?}: {holds} {fails}", claim.id());
        }
    }
}

#[test]
fn what_learned_nothing_is_compared_as_rarely_as_promised() {
    let (_folder, path) = file(KINDS);
    let claims = load(&path).unwrap().claims;
    let claim = claims.iter().find(|claim| claim.id() == "required").unwrap();
    for sizes in SIZES {
        let table = Table { sizes, of_datasets: 0.05, of_seeds: 0.05 };
        let (holds, fails) = verdicts(claim, &table, 1.0, 0.95);
        assert_rare(holds + fails, &format!("{sizes:?}"));
    }
}

#[test]
fn equal_networks_are_no_better_than_each_other() {
    let (_folder, path) = file(KINDS);
    let claims = load(&path).unwrap().claims;
    let claim = claims.iter().find(|claim| claim.id() == "margin").unwrap();
    let table = Table { sizes: (6, 2), of_datasets: 0.02, of_seeds: 0.05 };
    let (holds, fails) = verdicts(claim, &table, 0.0, 0.0);
    assert!(holds > 0.9 && fails < 0.001, "{holds} {fails}");
}
