//! Intervals over datasets and seeds, compared with printed tables and with random draws whose true mean is known.

use harness_analysis::{
    Estimate, Interval, Jackknife, LEVEL, holm, mean_interval, replicates, unpaired_replicates,
};
use harness_metrics::Metric;
use harness_spec::Split;
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const TRUTH: f64 = 0.3;
const TABLES: usize = 10_000;

fn p_value(values: &[f64], bound: f64) -> Option<f64> {
    Estimate::of(values)?.p_value(bound)
}

fn needed(values: &[f64], bound: f64) -> Option<usize> {
    Estimate::of(values)?.needed(bound, LEVEL, 100)
}

fn assert_close(a: f64, b: f64) {
    assert!((a - b).abs() < 1e-12 * b.abs().max(1.0), "{a} is not {b}");
}

#[test]
fn intervals_are_those_of_students_t() {
    // The quantiles are from a printed table. At 97.5 % and 95 %: 4.3027 and 2.9200 with 2 degrees of freedom, 2.7764
    // with 4.
    let half = |values: &[f64], level| {
        let Interval { mean, bounds } = mean_interval(values, level).unwrap();
        let (low, high) = bounds.unwrap();
        assert_close(mean - low, high - mean);
        high - mean
    };
    assert!((half(&[1.0, 2.0, 3.0], 0.95) - 4.3027 / 3.0_f64.sqrt()).abs() < 1e-4);
    assert!((half(&[1.0, 2.0, 3.0], 0.90) - 2.9200 / 3.0_f64.sqrt()).abs() < 1e-4);
    assert!((half(&[4.0, 8.0, 6.0, 5.0, 7.0], 0.95) - 2.7764 * 0.5_f64.sqrt()).abs() < 1e-4);
    assert_eq!(mean_interval(&[4.0, 8.0, 6.0], 0.95).unwrap().mean, 6.0);
    let same = mean_interval(&[0.5, 0.5], 0.95).unwrap();
    assert_eq!(same, Interval { mean: 0.5, bounds: Some((0.5, 0.5)) });
    // The sum of three times 0.1 is not 0.3 in floating point.
    let same = mean_interval(&[0.1; 3], 0.95).unwrap();
    assert_eq!(same, Interval { mean: 0.1, bounds: Some((0.1, 0.1)) });
    assert_eq!(p_value(&[0.1; 3], 0.2), None, "values that do not vary are not tested");
    assert_eq!(replicates([(0, 0.1), (0, 0.1), (0, 0.1), (1, 0.1), (1, 0.1)]), [0.1, 0.1]);
}

#[test]
fn one_seed_has_no_interval_and_none_no_mean() {
    let one = mean_interval(&[0.7], 0.95).unwrap();
    assert_eq!(one, Interval { mean: 0.7, bounds: None });
    assert_eq!((one.low(), one.high()), (0.7, 0.7));
    assert_eq!(mean_interval(&[], 0.95), None);
}

#[test]
fn an_interval_does_not_depend_on_the_order_of_its_seeds() {
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let mut values: [f32; 7] = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
    let of =
        |values: &[f32]| mean_interval(&values.iter().map(|&v| f64::from(v) / 3.0).collect::<Vec<_>>(), 0.95);
    let expected = of(&values);
    for seed in 0..20 {
        values.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
        assert_eq!(of(&values), expected);
    }
}

#[test]
fn an_interval_covers_the_mean_as_often_as_its_level_says() {
    let mut rng = ChaCha8Rng::seed_from_u64(12);
    let normal = rand_distr::Normal::new(3.0, 2.0).unwrap();
    let covered = (0..20_000).filter(|_| {
        let values: [f64; 3] = std::array::from_fn(|_| rng.sample(normal));
        let interval = mean_interval(&values, 0.95).unwrap();
        (interval.low()..=interval.high()).contains(&3.0)
    });
    // The standard deviation of the share is 0.0015.
    let share = covered.count() as f64 / 20_000.0;
    assert!((share - 0.95).abs() < 0.006, "{share}");
}

// --- several datasets ---

fn normal(random: &mut ChaCha8Rng) -> f64 {
    random.sample(rand_distr::StandardNormal)
}

/// The share of intervals that contain the true mean, when `values` draws the values of each.
fn coverage(mut values: impl FnMut(&mut ChaCha8Rng) -> Vec<f64>) -> f64 {
    let mut random = ChaCha8Rng::seed_from_u64(14);
    let covers = |_: &usize| {
        let (low, high) = mean_interval(&values(&mut random), LEVEL).unwrap().bounds.unwrap();
        low <= TRUTH && TRUTH <= high
    };
    (0..TABLES).filter(covers).count() as f64 / TABLES as f64
}

/// Random values with the dataset of each: the true mean, plus a deviation of the dataset, plus a deviation of the
/// seed.
fn table(random: &mut ChaCha8Rng, seeds: &[u64], of_datasets: f64, of_seeds: f64) -> Vec<(u64, f64)> {
    let dataset = |(dataset, seeds): (usize, &u64)| {
        let middle = TRUTH + of_datasets * normal(random);
        (0..*seeds).map(|_| (dataset as u64, middle + of_seeds * normal(random))).collect::<Vec<_>>()
    };
    seeds.iter().enumerate().flat_map(dataset).collect()
}

#[track_caller]
fn assert_covers(coverage: f64, what: &str) {
    assert!((0.93..=0.97).contains(&coverage), "{what}: {coverage}");
}

#[test]
fn intervals_over_the_seeds_of_one_dataset_keep_their_level() {
    for seeds in [2, 3, 5] {
        let coverage = coverage(|random| replicates(table(random, &[seeds], 0.0, 0.1)));
        assert_covers(coverage, &format!("{seeds} seeds"));
    }
}

#[test]
fn intervals_over_datasets_and_seeds_keep_level_at_any_variance() {
    // In the last table, a run is missing.
    for seeds in [&[2, 2][..], &[3, 3], &[2, 2, 2], &[3; 5], &[3, 3, 2]] {
        for ratio in [0.0, 0.5, 1.0, 3.0] {
            let coverage = coverage(|random| replicates(table(random, seeds, ratio * 0.1, 0.1)));
            assert_covers(coverage, &format!("{seeds:?} seeds, ratio {ratio}"));
        }
    }
    // If all values were treated as independent, the intervals would be far too short.
    let pooled = coverage(|random| {
        let table = table(random, &[3, 3, 3], 0.1, 0.1);
        table.into_iter().map(|(_, value)| value).collect()
    });
    assert!(pooled < 0.85, "{pooled}");
}

#[test]
fn intervals_of_differences_within_datasets_keep_their_level() {
    // Both networks share the deviation of a dataset. The difference between them also varies by dataset.
    for gain in [0.0, 0.05, 0.2] {
        let coverage = coverage(|random| {
            let without = table(random, &[2, 2, 2], 1.0, 0.1);
            let gains = table(random, &[2, 2, 2], gain, 0.0);
            let with: Vec<f64> = (without.iter().zip(&gains))
                .map(|((_, a), (_, gain))| a + gain + 0.1 * normal(random))
                .collect();
            replicates(without.iter().zip(with).map(|((dataset, a), b)| (*dataset, b - a)))
        });
        assert_covers(coverage, &format!("gains with a deviation of {gain}"));
    }
}

/// A claim about the best of several sizes is about the mean of the best over datasets.
#[test]
fn intervals_of_the_best_of_several_networks_cover_its_mean() {
    // The mean of the smallest of so many independent standard normal numbers (Harter, 1961, Biometrika 48).
    for (networks, smallest) in [(3, -0.846_28), (4, -1.029_38)] {
        for datasets in [3, 4] {
            let coverage = coverage(|random| {
                let best = |_| (0..networks).map(|_| normal(random)).fold(f64::INFINITY, f64::min);
                (0..datasets).map(best).map(|best| TRUTH + 0.1 * (best - smallest)).collect()
            });
            assert_covers(coverage, &format!("{networks} networks, {datasets} datasets"));
        }
    }
}

#[test]
fn several_datasets_count_by_their_means_and_one_by_its_seeds() {
    assert_eq!(replicates([(0, 1.0), (0, 3.0), (7, 5.0)]), [2.0, 5.0]);
    assert_eq!(replicates([(7, 1.0), (7, 3.0)]), [1.0, 3.0]);
    assert_eq!(replicates([]), [0.0; 0]);
}

#[test]
fn p_is_below_5_percent_where_the_interval_excludes_the_bound() {
    let mut random = ChaCha8Rng::seed_from_u64(3);
    for _ in 0..1000 {
        let values: Vec<f64> = (0..3).map(|_| 1.0 + normal(&mut random)).collect();
        let (low, high) = mean_interval(&values, LEVEL).unwrap().bounds.unwrap();
        let p = p_value(&values, 0.0).unwrap();
        assert_eq!(p < 1.0 - LEVEL, low > 0.0 || high < 0.0, "{values:?}: {p}");
    }
    // scipy.stats.ttest_1samp([1, 2, 4], 0).pvalue
    assert!((p_value(&[1.0, 2.0, 4.0], 0.0).unwrap() - 0.118_083).abs() < 1e-5);
    assert_eq!(p_value(&[1.0], 0.0), None);
}

#[test]
fn corrected_p_values_are_holm_s() {
    // By hand: 0.01 times 4, 0.02 times 3, 0.03 times 2, and never less than the previous p-value.
    let corrected = holm(&[0.03, 0.01, 0.9, 0.02]);
    let expected = [0.06, 0.04, 0.9, 0.06];
    assert!(corrected.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{corrected:?}");
    assert_eq!(holm(&[0.8, 0.7]), [1.0, 1.0]);
    assert!(holm(&[]).is_empty());
}

#[test]
fn the_planned_number_excludes_the_bound_if_the_spread_stays() {
    let values = [0.5, 1.5, 1.0];
    let count = needed(&values, 0.5).unwrap();
    // Deviation and distance are 0.5, so t(n - 1) must be less than the root of n. This holds from n = 7 on (2.447 and
    // 2.646).
    assert_eq!(count, 7);
    assert_eq!(needed(&values, 0.999), None);
    assert_eq!(needed(&[1.0], 0.0), None);
}

// --- unpaired differences ---

#[test]
fn a_difference_on_folds_allows_for_the_training_data_that_they_share() {
    let differences = [0.01, 0.03, 0.02, 0.04, 0.05];
    let plain = Estimate::of(&differences).unwrap();
    // By hand: s² = 0.00025, r = 0.2 / 0.7, so that the standard error is √(0.00025 (1/5 + 0.2857)) = 0.011019, and t of
    // 4 degrees of freedom is 2.776445.
    let split = Split { folds: Some(5), ..Split::default() };
    let ratio = split.test_to_training().unwrap();
    assert!((ratio - 0.2 / 0.7).abs() < 1e-12);
    let (low, high) = plain.of_folds(ratio).interval(LEVEL).bounds.unwrap();
    assert!(
        (low - (0.03 - 0.030_594)).abs() < 1e-5 && (high - (0.03 + 0.030_594)).abs() < 1e-5,
        "{low} {high}"
    );
    assert!(plain.interval(LEVEL).low() > 0.0 && plain.of_folds(ratio).p_value(0.0).unwrap() > 0.05);
    assert_eq!(plain.of_folds(0.0), plain);
    assert_eq!(Split::default().test_to_training(), None);
    assert_eq!(Split { folds: Some(2), validation: 0.5, ..split }.test_to_training(), None);
}

#[test]
fn an_unpaired_difference_is_that_of_welch_s_test() {
    // scipy.stats.ttest_ind([1, 2, 4], [2, 5, 9, 12], equal_var=False): p-value, and its 95 % interval.
    let difference = Estimate::difference(&[1.0, 2.0, 4.0], &[2.0, 5.0, 9.0, 12.0]).unwrap();
    let (low, high) = difference.interval(LEVEL).bounds.unwrap();
    assert!((difference.p_value(0.0).unwrap() - 0.122_121_1).abs() < 1e-6, "{difference:?}");
    assert!((low - -11.316_035).abs() < 1e-5 && (high - 1.982_702).abs() < 1e-5, "{low} {high}");
    assert_eq!(difference.count(), 3);
    assert_eq!(Estimate::difference(&[1.0], &[2.0, 3.0]).unwrap().interval(LEVEL).bounds, None);
    assert_eq!(Estimate::difference(&[], &[2.0, 3.0]), None);
    let equal = Estimate::difference(&[1.0, 1.0], &[2.0, 2.0]).unwrap();
    assert_eq!((equal.interval(LEVEL).bounds, equal.p_value(0.0)), (Some((-1.0, -1.0)), None));
}

#[test]
fn unpaired_groups_count_by_datasets_if_one_has_several() {
    let one = [(0, 1.0), (0, 3.0)];
    let several = [(0, 1.0), (0, 3.0), (1, 5.0)];
    assert_eq!(unpaired_replicates([one, one]), [vec![1.0, 3.0], vec![1.0, 3.0]]);
    assert_eq!(unpaired_replicates([one.to_vec(), several.to_vec()]), [vec![2.0], vec![2.0, 5.0]]);
}

#[test]
fn intervals_of_unpaired_differences_keep_their_level() {
    let mut random = ChaCha8Rng::seed_from_u64(15);
    for (sizes, spreads) in
        [([3, 3], [1.0, 1.0]), ([6, 6], [1.0, 3.0]), ([20, 20], [0.5, 2.0]), ([3, 6], [1.0, 1.0])]
    {
        let covers = |_: &usize| {
            let [a, b] = [0, 1].map(|group| {
                let value = |_| TRUTH * (1 - group) as f64 + spreads[group] * normal(&mut random);
                (0..sizes[group]).map(value).collect::<Vec<_>>()
            });
            let (low, high) = Estimate::difference(&a, &b).unwrap().interval(LEVEL).bounds.unwrap();
            low <= TRUTH && TRUTH <= high
        };
        let coverage = (0..TABLES).filter(covers).count() as f64 / TABLES as f64;
        assert_covers(coverage, &format!("{sizes:?} {spreads:?}"));
    }
}

// --- tests whose episodes have heavy tails ---

/// The sum of squared deviations of an episode.
type Sum = fn(&mut ChaCha8Rng) -> f64;

/// The error and the variance of each test episode, of two models on each dataset. An episode's error is a share of its
/// variance, times deviations of the dataset, of the episode, of the model on the episode, and of all three, all
/// log-normal. Datasets with a `shared` test have the same episodes, each as difficult for one network as for others.
fn sums_on_datasets(
    random: &mut ChaCha8Rng,
    sum: Sum,
    datasets: usize,
    episodes: usize,
    shared: bool,
) -> Vec<[Vec<[f64; 2]>; 2]> {
    let episode = |random: &mut ChaCha8Rng| {
        let (sum, all) = (sum(random), (0.5 * normal(random)).exp());
        (sum, [0; 2].map(|_| all * (0.3 * normal(random)).exp()))
    };
    let draw = |random: &mut ChaCha8Rng| (0..episodes).map(|_| episode(random)).collect::<Vec<_>>();
    let common = shared.then(|| draw(random));
    let dataset = |_| {
        let test = common.clone().unwrap_or_else(|| draw(random));
        [(0, 0.2), (1, 0.3)].map(|(model, share)| {
            let share = share * (0.1 * normal(random)).exp();
            let error = |(sum, difficulty): &(f64, [f64; 2])| {
                [sum * difficulty[model] * share * (0.2 * normal(random)).exp(), *sum]
            };
            test.iter().map(error).collect()
        })
    };
    (0..datasets).map(dataset).collect()
}

/// R2 of the first model, and its difference from that of the second.
fn values(models: &[Vec<[f64; 2]>; 2]) -> [f64; 2] {
    let [one, other] = models.each_ref().map(|sums| {
        let sum = |place: usize| sums.iter().map(|own| own[place]).sum::<f64>();
        Metric::R2.of_sums([sum(0), sum(1)]).unwrap()
    });
    [one, one - other]
}

/// The interval of the mean over datasets of R2 or of a difference, which is also over the episodes of a `shared` test.
fn interval_of_mean(tables: &[[Vec<[f64; 2]>; 2]], which: usize, shared: bool) -> Interval {
    let own: Vec<f64> = tables.iter().map(|models| values(models)[which]).collect();
    let estimate = Estimate::of(&own).unwrap();
    if !shared {
        return estimate.interval(LEVEL);
    }
    let jackknife = |models: &[Vec<[f64; 2]>; 2]| {
        let [one, other] = models.each_ref().map(|sums| Jackknife::new(Metric::R2, sums).unwrap());
        if which == 0 { one } else { one.minus(&other).unwrap() }
    };
    let jackknives: Vec<Jackknife> = tables.iter().map(jackknife).collect();
    let datasets: Vec<u64> = (0..tables.len() as u64).collect();
    estimate.interval_with_episodes(&Jackknife::mean(&jackknives, &datasets).unwrap(), LEVEL)
}

/// The difference is significant exactly where its interval excludes 0, at every level.
#[test]
fn a_p_value_is_that_of_the_interval_over_datasets_and_episodes() {
    let sums = |scale: f64| -> Vec<[f64; 2]> {
        (0..20).map(|episode| [scale * f64::from(1 + episode % 7), f64::from(2 + episode % 3)]).collect()
    };
    let [one, other] = [0.2, 0.21].map(|scale| Jackknife::new(Metric::R2, &sums(scale)).unwrap());
    let episodes =
        Jackknife::mean(&[one.minus(&other).unwrap(), one.minus(&other).unwrap()], &[0, 1]).unwrap();
    for values in [[0.02, 0.024], [0.5, 0.9], [0.001, 0.0011]] {
        let estimate = Estimate::of(&values).unwrap();
        let p = estimate.p_value_with_episodes(&episodes, 0.0).unwrap();
        assert!(p > estimate.p_value(0.0).unwrap(), "episodes add to what is not known");
        for (level, excludes) in [(1.0 - 1.001 * p, true), (1.0 - 0.999 * p, false)] {
            if level > 0.0 {
                let interval = estimate.interval_with_episodes(&episodes, level);
                assert_eq!(interval.low() > 0.0 || interval.high() < 0.0, excludes, "{values:?} {level}");
            }
        }
    }
    assert_eq!(Estimate::of(&[1.0]).unwrap().p_value_with_episodes(&episodes, 0.0), None);
}

/// The shares of intervals over `datasets` datasets that contain the mean over datasets and episodes of R2 and of a
/// difference, and of prediction intervals that contain R2 on one more dataset, in %.
fn coverages(sum: Sum, datasets: usize, episodes: usize, shared: bool) -> [f64; 3] {
    const REPEATED: usize = 4_000;
    let mut random = ChaCha8Rng::seed_from_u64(15);
    let all = sums_on_datasets(&mut random, sum, 1_000_000 / episodes, episodes, false);
    let means =
        [0, 1].map(|which| all.iter().map(|models| values(models)[which]).sum::<f64>() / all.len() as f64);
    let mut covered = [0; 3];
    for _ in 0..REPEATED {
        let mut tables = sums_on_datasets(&mut random, sum, datasets + 1, episodes, shared);
        let next = values(&tables.pop().unwrap())[0];
        let own: Vec<f64> = tables.iter().map(|models| values(models)[0]).collect();
        let intervals = [
            (interval_of_mean(&tables, 0, shared), means[0]),
            (interval_of_mean(&tables, 1, shared), means[1]),
            (Estimate::of(&own).unwrap().prediction(LEVEL), next),
        ];
        for (count, (interval, value)) in covered.iter_mut().zip(intervals) {
            *count += usize::from((interval.low()..=interval.high()).contains(&value));
        }
    }
    covered.map(|count| 100.0 * count as f64 / REPEATED as f64)
}

#[test]
fn intervals_of_tests_with_heavy_tails_cover_what_the_documentation_says() {
    let page = include_str!("../docs/metrics.md");
    let sums: [(&str, Sum); 3] = [
        ("uniform", |random| random.random_range(0.5..1.5)),
        ("log-normal, σ 1.5", |random| (1.5 * normal(random)).exp()),
        ("Pareto, α 1.5", |random| random.sample(rand_distr::Pareto::new(1.0, 1.5).unwrap())),
    ];
    let mut lacking = Vec::new();
    for (name, sum) in sums {
        for (episodes, shared) in [(20, false), (200, false), (20, true), (200, true)] {
            let [few, many] = [4, 6].map(|datasets| coverages(sum, datasets, episodes, shared));
            let test = if shared { "shared" } else { "own" };
            let pairs = few.iter().zip(many).map(|(few, many)| format!(" {few:.0} | {many:.0} |"));
            let row = format!("| {name} | {episodes} | {test} |{}", pairs.collect::<String>());
            println!("{row}");
            let mut all = few.into_iter().chain(many);
            // The intervals over datasets alone suppose about normal values. The page shows how far they are off for
            // others. Those over episodes, too, hold for all.
            match shared {
                true => assert!(all.all(|share| share >= 94.0), "{row}"),
                false if name == "uniform" => {
                    assert!(all.all(|share| (93.0..=97.0).contains(&share)), "{row}")
                }
                false => {}
            }
            lacking.extend((!page.contains(&row)).then_some(row));
        }
    }
    assert!(lacking.is_empty(), "docs/metrics.md lacks these rows: {lacking:#?}");
}

#[test]
fn jackknives_are_those_of_hand_worked_sums() {
    // MAE is 4 / 4. Without each episode it is 3 / 2, 3 / 3 and 2 / 3, so the changes are 4/9, -1/18 and -7/18.
    let sums = [[1.0, 2.0], [1.0, 1.0], [2.0, 1.0]];
    let one = Jackknife::new(Metric::Mae, &sums).unwrap();
    // s² = 2/3 (64 + 1 + 49) / 324 = 0.484322². With (64 + 1 + 49)² / (64² + 1 + 49²) = 2 degrees of freedom,
    // t = 4.3027.
    assert!((one.half(LEVEL) - 4.3027 * 0.484_322).abs() < 1e-4, "{}", one.half(LEVEL));
    assert_eq!(one.minus(&one).unwrap().half(LEVEL), 0.0);
    // The mean over two datasets, of which one has two seeds.
    let mean = Jackknife::mean(&[one.clone(), one.minus(&one).unwrap(), one.clone()], &[0, 0, 1]).unwrap();
    assert_close(mean.half(LEVEL), 0.75 * one.half(LEVEL));
    let estimate = Estimate::of(&[0.5, 1.5]).unwrap();
    let half = |interval: Interval| interval.high() - interval.mean;
    let both = half(estimate.interval_with_episodes(&mean, LEVEL));
    assert_close(both, half(estimate.interval(LEVEL)).hypot(mean.half(LEVEL)));
    assert_eq!(Estimate::of(&[0.5]).unwrap().interval_with_episodes(&mean, LEVEL).bounds, None);
    assert_eq!(Jackknife::new(Metric::Mae, &sums[..1]), None);
    assert_eq!(Jackknife::new(Metric::R2, &[[1.0, 0.0], [1.0, 2.0]]), None, "no variance without the second");
    assert_eq!(Jackknife::mean(&[], &[]), None);
}

#[test]
fn a_prediction_interval_is_that_of_students_t() {
    // By hand: t = 4.3027, s = 1, √(1 + 1/3) = 1.1547.
    let Interval { mean, bounds } = Estimate::of(&[1.0, 2.0, 3.0]).unwrap().prediction(0.95);
    let (low, high) = bounds.unwrap();
    assert!(mean == 2.0 && (high - 2.0 - 4.9683).abs() < 1e-3 && (2.0 - low - 4.9683).abs() < 1e-3);
    assert_eq!(Estimate::of(&[1.0]).unwrap().prediction(0.95).bounds, None);
}
