//! The metrics and baselines, compared with values calculated by hand and by scikit-learn.

use finger::{ARM_JOINTS, FRAME_LEN, FRAME_SIDE, JOINTS};
use harness_metrics::baselines::{GRAY_SIDE, Ridge, RidgeSums, TrainingMean, downsample_frame, persistence};
use harness_metrics::contact::{Contact, by_link};
use harness_metrics::parts::{class_of, in_either, region_of};
use harness_metrics::series::value;
use harness_metrics::{
    Direction, Ensemble, Evaluation, ForceEvaluation, Forces, Members, Metric, MetricsError, Points, Row,
    Series, evaluate, latent,
};
use harness_spec::{Definition, Element, Layout, Modality};
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};
use std::io::Write;
use std::process::{Command, Stdio};

#[path = "common/finger.rs"]
mod finger;

/// Path of the repository.
const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");

fn of_finger(modality: Modality) -> Definition {
    Layout::finger()[modality].clone()
}

#[test]
fn a_dimension_of_the_latent_state_is_active_above_a_hundredth_of_a_nat() {
    let rows = latent::rows(&[0.009, 0.011, 0.5]);
    let found = rows.iter().map(|row| (row.metric, row.index, row.value.unwrap()));
    let each = [0.009, 0.011, 0.5].into_iter().enumerate();
    let each = each.map(|(index, nats)| (Metric::Kl, Some(index as u32), nats));
    let expected = [(Metric::Kl, None, 0.52), (Metric::Active, None, 2.0)].into_iter().chain(each);
    assert_eq!(found.collect::<Vec<_>>(), expected.collect::<Vec<_>>());
}

macro_rules! formulas {
    ($($name:ident = $metric:ident, $is_change:literal;)*) => {
        $(fn $name(series: &[Series]) -> Option<f64> {
            value(Metric::$metric, $is_change, series)
        })*
    };
}

formulas! {
    smape = Smape, false;
    wmape = Wmape, false;
    r2 = R2, false;
    rmse = Rmse, false;
    mae = Mae, false;
    error_relative_to_zero = RelativeError, true;
    error_relative_to_mean = RelativeError, false;
}

type Formula = fn(&[Series]) -> Option<f64>;
const FUNCTIONS: [Formula; 7] = [smape, wmape, r2, rmse, mae, error_relative_to_zero, error_relative_to_mean];

fn series(reference: &[f32], predicted: &[f32]) -> [Series; 1] {
    assert_eq!(reference.len(), predicted.len());
    [reference.iter().copied().zip(predicted.iter().copied()).collect()]
}

#[track_caller]
fn assert_close(value: impl Into<Option<f64>>, expected: f64) {
    let value = value.into().expect("the metric is defined");
    let tolerance = 1e-9 * expected.abs().max(1.0);
    assert!((value - expected).abs() <= tolerance, "{value} is not {expected}");
}

/// `samples` values around `offset`, and predictions whose error is about a tenth of the values' standard deviation.
fn random_pairs(seed: u64, samples: usize, offset: f32) -> (Vec<f32>, Vec<f32>) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let reference: Vec<f32> = (0..samples).map(|_| offset + rng.random_range(-1.0..1.0)).collect();
    let predicted = reference.iter().map(|r| r + rng.random_range(-0.2..0.2)).collect();
    (reference, predicted)
}

/// The names of the regions of the finger's images.
fn of_images() -> Vec<String> {
    Layout::finger().regions_of(Modality::FRAME_DIFFERENCE)
}

fn find(rows: &[Row], metric: Metric, direction: Option<Direction>, index: Option<u32>) -> &Row {
    let mut found =
        rows.iter().filter(|row| (row.metric, row.direction, row.index) == (metric, direction, index));
    let row = found.next().expect("the row is there");
    assert!(found.next().is_none(), "{row:?} is there twice");
    row
}

/// The values that scikit-learn and NumPy compute for `request`.
fn python(request: &Value) -> Value {
    let mut child = Command::new(format!("{ROOT}/.venv/bin/python"))
        .arg(format!("{ROOT}/tests/python/reference_metrics.py"))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect("the virtual environment of the tests is there: `make test` sets it up");
    child.stdin.take().unwrap().write_all(request.to_string().as_bytes()).unwrap();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "reference_metrics.py failed");
    serde_json::from_slice(&output.stdout).unwrap()
}

/// The columns `columns` of a row-major matrix as nested lists. Their values are exact in f64.
fn nested(matrix: &[f32], width: usize, columns: impl Iterator<Item = usize> + Clone) -> Value {
    matrix
        .chunks_exact(width)
        .map(|row| columns.clone().map(|column| f64::from(row[column])).collect::<Vec<_>>())
        .collect()
}

// --- formulas ---

#[test]
fn formulas_give_hand_worked_values() {
    // The errors are 0, 1, 0, 2. The reference's mean is 1.75, and the sum of its squared deviations is 8.75.
    let pairs = series(&[1.0, 2.0, 0.0, 4.0], &[1.0, 1.0, 0.0, 6.0]);
    assert_close(smape(&pairs), 100.0 / 4.0 * (1.0 / 3.0 + 2.0 / 10.0));
    assert_close(wmape(&pairs), 100.0 * 3.0 / 7.0);
    assert_close(r2(&pairs), 1.0 - 5.0 / 8.75);
    assert_close(rmse(&pairs), 1.25_f64.sqrt());
    assert_close(mae(&pairs), 0.75);
    assert_close(error_relative_to_zero(&pairs), 5.0 / 21.0);
    assert_close(error_relative_to_mean(&pairs), 5.0 / 8.75);
}

#[test]
fn smape_lies_between_0_and_100() {
    assert_close(smape(&series(&[0.0, 3.0], &[0.0, 3.0])), 0.0);
    assert_close(smape(&series(&[1.0, -2.0, 0.0], &[-1.0, 5.0, 0.1])), 100.0);
}

#[test]
fn undefined_metrics_are_none() {
    assert!(FUNCTIONS.iter().all(|metric| metric(&[]).is_none() && metric(&[Series::default()]).is_none()));
    let untouched = series(&[0.0; 3], &[0.0, 0.5, 0.0]);
    assert_eq!(wmape(&untouched), None);
    assert_eq!(r2(&untouched), None);
    assert_eq!(error_relative_to_zero(&untouched), None);
    assert_eq!(error_relative_to_mean(&untouched), None);
    assert_close(mae(&untouched), 0.5 / 3.0);
    // 0.1 has no exact binary form. In spite of rounding, a constant must count as constant.
    assert_eq!(r2(&series(&[0.1; 1000], &[0.2; 1000])), None);
}

#[test]
fn round_off_has_no_r2() {
    let angle = |name: &str| Element { name: name.into(), unit: "rad".into() };
    let definition = Definition::vector(Modality::PROPRIOCEPTION, "", vec![angle("a"), angle("b")]);
    let r2_of = |unit: &str, reference: &[f32]| {
        let element = Element { name: "a".into(), unit: unit.into() };
        let definition = Definition::vector(Modality::PROPRIOCEPTION, "", vec![element]);
        let rows = evaluate(&definition, reference, &vec![0.0; reference.len()]).unwrap();
        rows.iter().find(|row| row.metric == Metric::R2).unwrap().value
    };
    // A simulation computes positions in m with larger numbers than these. A recorded capacitance may be that small.
    for unit in ["m", "rad/s", "N m", "m/s^2"] {
        assert_eq!((r2_of(unit, &[4e-15, -4e-15]), r2_of(unit, &[1e-9, -1e-9])), (None, Some(0.0)), "{unit}");
    }
    assert_eq!(r2_of("F", &[4e-15, -4e-15]), Some(0.0));
    // The second angle is round-off: of its own value, and of what the first one was computed with.
    for still in [[5.0, f32::from_bits(5.0_f32.to_bits() + 1)], [1e-18, -1e-18]] {
        let reference = [1.0, still[0], 2.0, still[1]];
        let r2: Vec<Option<f64>> = evaluate(&definition, &reference, &[1.0, 1.0, 2.0, 1.0])
            .unwrap()
            .into_iter()
            .filter(|row| row.metric == Metric::R2)
            .map(|row| row.value)
            .collect();
        assert_eq!(r2, [Some(1.0), Some(1.0), None]);
    }
}

#[test]
fn pooling_adds_the_sums_of_the_series() {
    let varying = series(&[1.0, 3.0], &[1.0, 2.0])[0];
    let constant = series(&[5.0, 5.0], &[5.0, 8.0])[0];
    let both = [varying, constant];
    assert_close(smape(&both), 100.0 / 4.0 * (1.0 / 5.0 + 3.0 / 13.0));
    assert_close(wmape(&both), 100.0 * 4.0 / 14.0);
    assert_close(rmse(&both), 2.5_f64.sqrt());
    assert_close(mae(&both), 1.0);
    assert_close(r2(&both), 1.0 - 1.0 / 2.0);
    assert_close(error_relative_to_mean(&both), 10.0 / 2.0);
    // Each series has its own mean, so a large distance between the means adds no variance.
    let high = series(&[101.0, 103.0], &[101.0, 102.0])[0];
    assert_close(r2(&[varying, high]), 1.0 - 2.0 / 4.0);
}

#[test]
fn ratios_ignore_scale_and_r2_ignores_offset() {
    let (reference, predicted) = random_pairs(1, 500, 0.5);
    let pairs = series(&reference, &predicted);
    // Multiplying by a power of two does not round.
    let scale = |values: &[f32]| values.iter().map(|value| value * 1024.0).collect::<Vec<_>>();
    let scaled = series(&scale(&reference), &scale(&predicted));
    for metric in [smape, wmape, r2, error_relative_to_zero, error_relative_to_mean] {
        assert_close(metric(&scaled), metric(&pairs).unwrap());
    }
    for metric in [rmse, mae] {
        assert_close(metric(&scaled), 1024.0 * metric(&pairs).unwrap());
    }
    let shift = |values: &[f32]| values.iter().map(|value| value + 1.0).collect::<Vec<_>>();
    let shifted = r2(&series(&shift(&reference), &shift(&predicted))).unwrap();
    assert!((shifted - r2(&pairs).unwrap()).abs() < 1e-6);
}

#[test]
fn metrics_ignore_the_order_of_samples() {
    let (reference, predicted) = random_pairs(2, 500, 0.1);
    let mut order: Vec<usize> = (0..reference.len()).collect();
    order.shuffle(&mut ChaCha8Rng::seed_from_u64(3));
    let shuffled: Series = order.iter().map(|&i| (reference[i], predicted[i])).collect();
    for metric in FUNCTIONS {
        assert_close(metric(&[shuffled]), metric(&series(&reference, &predicted)).unwrap());
    }
}

// --- evaluation of a modality ---

#[test]
fn evaluation_agrees_with_scikit_learn() {
    // With an offset, the variance is a small part of the sum of squares, so a careless sum loses digits.
    for (modality, metrics, offset) in [
        (Modality::PROPRIOCEPTION, [Metric::Smape, Metric::R2, Metric::Rmse, Metric::Mae], 0.0),
        (Modality::CONTACT_FORCE_MEAN, [Metric::Wmape, Metric::R2, Metric::Rmse, Metric::Mae], 1000.0),
    ] {
        let (reference, predicted) = random_pairs(4, 300 * JOINTS, offset);
        let rows = evaluate(&of_finger(modality), &reference, &predicted).unwrap();
        let compare = |direction, index, columns: Vec<usize>| {
            let expected = python(&json!({
                "reference": nested(&reference, JOINTS, columns.iter().copied()),
                "predicted": nested(&predicted, JOINTS, columns.iter().copied()),
            }));
            for metric in metrics {
                let value = find(&rows, metric, direction, index).value;
                assert_close(value, expected[metric.name()].as_f64().unwrap());
            }
        };
        compare(None, None, (0..JOINTS).collect());
        compare(Some(Direction::FLEXION_EXTENSION), None, (0..JOINTS).step_by(2).collect());
        compare(Some(Direction::ADDUCTION_ABDUCTION), Some(7), vec![7]);
    }
}

/// The definition of some categories.
fn of_objects(names: &[&str]) -> Definition {
    let elements = names.iter().map(|name| Element { name: (*name).to_owned(), unit: String::new() });
    let name = Modality::new("object").unwrap();
    Definition { category: true, ..Definition::vector(name, "", elements.collect()) }
}

/// The rows of samples with these categories and predicted probabilities.
fn judged(definition: &Definition, categories: &[usize], probabilities: &[f32]) -> Vec<Row> {
    let width = definition.width();
    let elements = |category: usize| (0..width).map(move |place| f32::from(u8::from(place == category)));
    let reference: Vec<f32> = categories.iter().copied().flat_map(elements).collect();
    evaluate(definition, &reference, probabilities).unwrap()
}

#[test]
fn metrics_of_categories_are_those_of_hand_worked_counts() {
    // Two of three balls, and one of two books, are predicted right. Equal probabilities are those of the first one.
    let definition = of_objects(&["ball", "book", "cup"]);
    let probabilities = [0.5, 0.25, 0.25, 0.4, 0.4, 0.2, 0.25, 0.5, 0.25, 0.25, 0.5, 0.25, 0.25, 0.25, 0.5];
    let rows = judged(&definition, &[0, 0, 0, 1, 1], &probabilities);
    let whole = |metric| find(&rows, metric, None, None).value;
    assert_close(whole(Metric::Accuracy), 3.0 / 5.0);
    assert_close(whole(Metric::BalancedAccuracy), (2.0 / 3.0 + 1.0 / 2.0) / 2.0);
    let log_loss = -[0.5f64, f64::from(0.4f32), 0.25, 0.5, 0.25].map(f64::ln).iter().sum::<f64>() / 5.0;
    assert!((whole(Metric::LogLoss).unwrap() - log_loss).abs() < 1e-7);
    let of = |name: &str, index: u32, metric: Metric| {
        find(&rows, metric, Some(Direction::new(name)), Some(index)).value
    };
    assert_close(of("ball", 0, Metric::Accuracy), 2.0 / 3.0);
    assert_eq!(of("cup", 2, Metric::Accuracy), None);
    let pairs = [
        ("ball as ball", 0, 2.0),
        ("ball as book", 0, 1.0),
        ("book as book", 1, 1.0),
        ("book as cup", 1, 1.0),
    ];
    for (pair, index, count) in pairs {
        assert_close(of(pair, index, Metric::Confusion), count);
    }
    assert_eq!(rows.iter().filter(|row| row.metric == Metric::Confusion).count(), pairs.len());
    assert_eq!(find(&rows, Metric::LogLoss, None, None).unit, "nats");
    assert_eq!(rows.len(), 3 + 3 + pairs.len(), "no errors of the elements");
    // Certainty of a wrong category has a finite loss, and a regression has one too.
    let wrong = judged(&definition, &[2], &[1.0, -0.5, -1.0]);
    let least = f64::from(f32::EPSILON);
    assert_close(find(&wrong, Metric::LogLoss, None, None).value, -(least / (1.0 + 2.0 * least)).ln());
    assert!(Metric::Accuracy.higher_is_better() && !Metric::LogLoss.higher_is_better());
    assert!(!Metric::Confusion.is_judgment());
    assert_eq!(Metric::named("accuracy_from_2s"), Some(Metric::Accuracy.in_region("from_2s")));
}

#[test]
fn metrics_of_categories_agree_with_scikit_learn() {
    const NAMES: [&str; 5] = ["a", "b", "c", "d", "e"];
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let definition = of_objects(&NAMES);
    // The last category is never there. Some probabilities are 0.
    let categories: Vec<usize> = (0..400).map(|_| rng.random_range(0..4)).collect();
    let mut probabilities = Vec::new();
    for category in &categories {
        let mut row: [f32; 5] = std::array::from_fn(|_| f32::max(rng.random_range(-0.1..1.0), 0.0));
        row[*category] += 0.3;
        let sum: f32 = row.iter().sum();
        probabilities.extend(row.map(|value| value / sum));
    }
    let rows = judged(&definition, &categories, &probabilities);
    let request = json!({ "category": categories, "probabilities": nested(&probabilities, 5, 0..5) });
    let expected = &python(&json!({ "categories": request }))["categories"];
    for metric in [Metric::Accuracy, Metric::BalancedAccuracy, Metric::LogLoss] {
        let found = find(&rows, metric, None, None).value.unwrap();
        assert!((found - expected[metric.name()].as_f64().unwrap()).abs() < 1e-6, "{metric:?} {found}");
    }
    for (index, name) in NAMES.iter().enumerate() {
        for (place, predicted) in NAMES.iter().enumerate() {
            let pair = Direction::new(&format!("{name} as {predicted}"));
            let is_it = |row: &&Row| row.metric == Metric::Confusion && row.direction == Some(pair);
            let count = rows.iter().find(is_it).map_or(0.0, |row| row.value.unwrap());
            assert_eq!(count, expected["confusion"][index][place].as_f64().unwrap(), "{name} as {predicted}");
        }
    }
}

#[test]
fn the_angle_is_that_of_the_directions_there_are() {
    let elements = ["a_x", "a_y", "a_z", "b_x", "b_y", "b_z"];
    let definition = Definition { unit_vectors: true, category: false, ..of_objects(&elements) };
    let mut evaluation = Evaluation::new(&definition, &[]);
    // A right angle, no direction, half a right angle, and a prediction without a direction.
    evaluation.add(&[1.0, 0.0, 0.0, 0.0, 0.0, 0.0], &[0.0, 0.0, 2.0, 9.0, 9.0, 9.0]).unwrap();
    evaluation.end_episode(2);
    evaluation.add(&[0.0, 1.0, 0.0, 0.0, 0.6, 0.8], &[0.0, 3.0, 3.0, 0.0, 0.0, 0.0]).unwrap();
    evaluation.end_episode(3);
    let rows = evaluation.rows();
    let right = std::f64::consts::FRAC_PI_2;
    let of = |index| find(&rows, Metric::Angle, None, index).value;
    assert_close(of(None), 2.5 * right / 3.0);
    assert_close(of(Some(0)), 1.5 * right / 2.0);
    assert_close(of(Some(3)), right);
    assert_eq!((rows.len(), rows[0].unit.as_str()), (3, "rad"));
    assert!(Metric::Angle.is_judgment() && !Metric::Angle.higher_is_better());
    let sums = evaluation.sums();
    let sums: Vec<_> = sums.iter().map(|row| (row.metric, row.episode, row.denominator)).collect();
    assert_eq!(sums, [(Metric::Angle, 2, 1.0), (Metric::Angle, 3, 2.0)]);
    let none = evaluate(&definition, &[0.0; 6], &[1.0; 6]).unwrap();
    assert_eq!(find(&none, Metric::Angle, None, None).value, None);
}

#[test]
fn sums_of_episodes_give_the_accuracy_and_the_log_loss_of_the_test() {
    let definition = of_objects(&["ball", "book"]);
    let mut evaluation = Evaluation::new(&definition, &[]);
    // An episode may come in parts.
    for (episode, category, share) in [(4, 0, 0.75), (4, 0, 0.25), (7, 1, 0.25)] {
        let reference = [f32::from(u8::from(category == 0)), f32::from(u8::from(category == 1))];
        evaluation.add(&reference, &[share, 1.0 - share]).unwrap();
        evaluation.end_episode(episode);
    }
    let sums = evaluation.sums();
    let of = |metric: Metric| -> Vec<(u32, [f64; 2])> {
        let own = sums.iter().filter(|row| row.metric == metric);
        own.map(|row| (row.episode, [row.numerator, row.denominator])).collect()
    };
    assert_eq!(of(Metric::Accuracy), [(4, [1.0, 2.0]), (7, [1.0, 1.0])]);
    let losses = of(Metric::LogLoss);
    assert_close(losses[0].1[0], -(0.75f64.ln() + 0.25f64.ln()));
    assert_close(losses[1].1[0], -(0.75f64.ln()));
    let rows = evaluation.rows_of_region("from_2s");
    let all: f64 = losses.iter().map(|(_, sums)| sums[0]).sum();
    assert_close(find(&rows, Metric::LogLoss.in_region("from_2s"), None, None).value, all / 3.0);
}

#[test]
fn finger_rows_name_joints_directions_and_units() {
    let (reference, predicted) = random_pairs(5, 10 * JOINTS, 0.0);
    let rows = evaluate(&of_finger(Modality::PROPRIOCEPTION), &reference, &predicted).unwrap();
    assert_eq!(rows.len(), 4 * (1 + 2 + JOINTS));
    assert!(rows.iter().all(|row| row.modality == Modality::PROPRIOCEPTION && row.value.is_some()));
    for joint in 0..JOINTS {
        let direction = if joint % 2 == 0 { "fe" } else { "aa" };
        let rows: Vec<_> = rows.iter().filter(|row| row.index == Some(joint as u32)).collect();
        assert!(rows.iter().all(|row| row.direction.unwrap().name() == direction));
        assert_eq!(
            rows.iter().map(|row| row.metric.name()).collect::<Vec<_>>(),
            ["smape", "r2", "rmse", "mae"]
        );
        assert_eq!(rows.iter().map(|row| row.unit.as_str()).collect::<Vec<_>>(), ["%", "1", "rad", "rad"]);
    }
}

#[test]
fn untouched_links_have_no_wmape() {
    // Only the last link is touched. The error of every prediction is 0.5 N.
    let reference: Vec<f32> =
        (0..5 * JOINTS).map(|i| if i % JOINTS == JOINTS - 1 { (i / JOINTS) as f32 } else { 0.0 }).collect();
    let predicted: Vec<f32> = reference.iter().map(|force| force + 0.5).collect();
    let rows = evaluate(&of_finger(Modality::CONTACT_FORCE), &reference, &predicted).unwrap();
    let value = |metric, direction, index| find(&rows, metric, direction, index).value;
    let (fe, aa) = (Some(Direction::FLEXION_EXTENSION), Some(Direction::ADDUCTION_ABDUCTION));
    for metric in [Metric::Wmape, Metric::R2] {
        assert_eq!(value(metric, fe, Some(0)), None);
        assert_eq!(value(metric, fe, None), None);
    }
    assert_close(value(Metric::Mae, fe, Some(0)), 0.5);
    // Forces of 0 to 4 N have a sum of 10 N. Predicted forces on untouched links count in the pooled error.
    assert_close(value(Metric::Wmape, aa, Some(19)), 100.0 * 2.5 / 10.0);
    assert_close(value(Metric::Wmape, aa, None), 100.0 * 25.0 / 10.0);
    assert_close(value(Metric::Wmape, None, None), 100.0 * 50.0 / 10.0);
    assert_close(value(Metric::R2, None, None), 1.0 - 1.25 / 10.0);
    assert!(rows.iter().all(|row| row.value.is_none_or(f64::is_finite)));
    assert_eq!(find(&rows, Metric::Rmse, None, None).unit, "N");
}

#[test]
fn joints_of_different_units_are_pooled_by_unit() {
    let (reference, predicted) = random_pairs(6, 10 * ARM_JOINTS, 0.0);
    let rows = evaluate(&of_finger(Modality::ARM), &reference, &predicted).unwrap();
    let part = |row: &Row| row.direction.map(Direction::name);
    let seen: Vec<_> =
        rows.iter().map(|row| (part(row), row.index, row.metric.name(), row.unit.as_str())).collect();
    let of = |part, joint, unit| {
        [(part, joint, "r2", "1"), (part, joint, "rmse", unit), (part, joint, "mae", unit)]
    };
    let parts = [of(Some("in rad"), None, "rad"), of(Some("in m"), None, "m")];
    let joints = [of(None, Some(0), "rad"), of(None, Some(1), "m"), of(None, Some(2), "m")];
    assert_eq!(seen, [parts.concat(), joints.concat()].concat());
    // The sums of the formulas run over the pooled elements: the mean of the two slides' absolute errors.
    let mae = |place: usize| {
        rows.iter().filter(|row| row.metric.name() == "mae").nth(place).unwrap().value.unwrap()
    };
    assert!((mae(1) - 0.5 * (mae(3) + mae(4))).abs() < 1e-12);
}

#[test]
fn frame_difference_is_compared_with_no_change() {
    let mut reference = vec![0.0; 2 * FRAME_LEN];
    reference[5] = 0.5;
    reference[FRAME_LEN + 7] = -0.5;
    let relative_error = |predicted: &[f32]| {
        let rows = evaluate(&of_finger(Modality::FRAME_DIFFERENCE), &reference, predicted).unwrap();
        assert_eq!(
            rows.iter().map(|row| row.metric.name()).collect::<Vec<_>>(),
            ["relative_error", "rmse", "mae"],
            "no regions are told apart"
        );
        assert!(
            rows.iter().all(|row| row.unit.as_str() == "1" && row.index.is_none() && row.direction.is_none())
        );
        find(&rows, Metric::RelativeError, None, None).value
    };
    assert_close(relative_error(&reference), 0.0);
    assert_close(relative_error(&persistence(&of_finger(Modality::FRAME_DIFFERENCE), &reference)), 1.0);
    let mut half = reference.clone();
    half[5] = 0.0;
    assert_close(relative_error(&half), 0.5);
    let still = vec![0.0; FRAME_LEN];
    let rows = evaluate(&of_finger(Modality::FRAME_DIFFERENCE), &still, &reference[..FRAME_LEN]).unwrap();
    assert_eq!(find(&rows, Metric::RelativeError, None, None).value, None);
    assert_close(find(&rows, Metric::Mae, None, None).value, 0.5 / FRAME_LEN as f64);
}

#[test]
fn the_arms_and_the_fingers_pixels_have_errors_of_their_own() {
    const PLANE: usize = FRAME_SIDE * FRAME_SIDE;
    // Pixel 3 shows the arm, pixel 5 the finger, pixel 7 neither. The change is 0.5 in all channels. The prediction is
    // 0.25 on the arm, 0.4 on the finger and 9 elsewhere.
    let mut parts = vec![None; PLANE];
    (parts[3], parts[5]) = (Some(0), Some(1));
    let (mut reference, mut predicted) = (vec![0.0; FRAME_LEN], vec![0.0; FRAME_LEN]);
    for channel in 0..3 {
        for (pixel, value) in [(3, 0.25), (5, 0.4), (7, 9.0)] {
            reference[channel * PLANE + pixel] = 0.5;
            predicted[channel * PLANE + pixel] = value;
        }
    }
    let mut evaluation = Evaluation::new(&of_finger(Modality::FRAME_DIFFERENCE), &of_images());
    evaluation.add_with_regions(&reference, &predicted, &parts).unwrap();
    let value = |metric| find(&evaluation.rows(), metric, None, None).value;
    assert_close(value(Metric::RelativeError.in_region("arm")), 0.25);
    assert!(
        (value(Metric::RelativeError.in_region("finger")).unwrap() - 0.04).abs() < 1e-6,
        "f32 rounds 0.4"
    );
    assert!(value(Metric::RelativeError).unwrap() > 90.0, "all pixels count there");

    let mut unseen = Evaluation::new(&of_finger(Modality::FRAME_DIFFERENCE), &of_images());
    unseen.add_with_regions(&reference, &predicted, &[None; PLANE]).unwrap();
    assert_eq!(find(&unseen.rows(), Metric::RelativeError.in_region("finger"), None, None).value, None);
    assert!(unseen.add_with_regions(&reference, &predicted, &parts[1..]).is_err());
    assert!(unseen.add_with_regions(&reference, &predicted, &[None; 2 * PLANE]).is_err());
}

#[test]
fn sums_of_episodes_give_the_metrics() {
    let kinds = ["ground", "box"].map(String::from).to_vec();
    let force = Definition { contact_kinds: kinds, ..of_finger(Modality::CONTACT_FORCE) };
    let mut random = ChaCha8Rng::seed_from_u64(8);
    for definition in [force, of_finger(Modality::ARM), of_finger(Modality::FRAME_DIFFERENCE)] {
        let (width, is_force) = (definition.width(), definition.is_force());
        let mut evaluation = Evaluation::new(&definition, &of_images());
        // Episode 7 comes in two batches. Links below 12 are never touched, and link 12 only in the first episode.
        for (episode, samples) in [(4, 6), (7, 3), (7, 2), (9, 1)] {
            let (mut reference, predicted) = random_pairs(random.random(), samples * width, 0.5);
            let touches = |link: usize| link > 12 || link == 12 && episode == 4;
            let untouched = (0..samples * width).filter(|place| is_force && !touches(place % width));
            untouched.for_each(|place| reference[place] = 0.0);
            let pixels = if definition.is_image() { width / 3 } else { width };
            let kinds = if definition.is_image() { 2 } else { 3 };
            let parts = (0..samples * pixels).map(|_| Some(random.random_range(0..kinds)));
            let parts: Vec<Option<u8>> = parts.collect();
            match evaluation.has_regions() {
                true => evaluation.add_with_regions(&reference, &predicted, &parts).unwrap(),
                false => evaluation.add(&reference, &predicted).unwrap(),
            }
            evaluation.end_episode(episode);
        }
        let sums = evaluation.sums();
        let is_whole = |row: &&Row| {
            row.index.is_none() && row.direction.is_none_or(|direction| direction.name().starts_with("in "))
        };
        let has_sums = |row: &&Row| match row.metric {
            Metric::Regional(metric, _) => matches!(metric, Metric::R2 | Metric::RelativeError),
            _ => true,
        };
        for row in evaluation.rows().iter().filter(is_whole).filter(has_sums) {
            let own = sums.iter().filter(|of| (of.metric, of.direction) == (row.metric, row.direction));
            let episodes: Vec<u32> = own.clone().map(|of| of.episode).collect();
            assert_eq!(episodes, [4, 7, 9], "{row:?}");
            let of = own.fold([0.0; 2], |[n, d], of| [n + of.numerator, d + of.denominator]);
            let value = row.metric.of_sums(of).expect("the metric is defined");
            assert!((value - row.value.unwrap()).abs() < 1e-9, "{value} {row:?}");
        }
    }
    // By hand: the mean of all references is 2, so the deviations of the last episode are 0 and 4.
    let joint = Element { name: "joint".into(), unit: "rad".into() };
    let mut evaluation = Evaluation::new(&Definition::vector(Modality::ARM, "a joint", vec![joint]), &[]);
    for (episode, reference, predicted) in [(0, [1.0, 1.0], [1.0, 2.0]), (1, [2.0, 4.0], [2.0, 1.0])] {
        evaluation.add(&reference, &predicted).unwrap();
        evaluation.end_episode(episode);
    }
    let sums = evaluation.sums();
    let r2 = sums.iter().filter(|of| of.metric == Metric::R2).flat_map(|of| [of.numerator, of.denominator]);
    r2.zip([1.0, 2.0, 9.0, 4.0]).for_each(|(sum, expected)| assert_close(sum, expected));
}

#[test]
fn contacts_of_each_kind_have_metrics_of_their_own() {
    let kinds = ["ground", "box"].map(String::from).to_vec();
    let force = Definition { contact_kinds: kinds, ..of_finger(Modality::CONTACT_FORCE) };
    assert_eq!(force.contact_kind().unwrap().name(), "contact_force_kind");
    // Two samples of 20 links. Link 19 touches the ground with 2 N and then with 4 N, and link 18 a box with 1 N and
    // then with 3 N. The last contact of link 17 is of another kind. All else is untouched, with a prediction of 0.5 N.
    let (mut reference, mut predicted) = (vec![0.0; 40], vec![0.5; 40]);
    let mut kind = vec![Some(0); 40];
    let contacts =
        [(19, 2.0, 2.5, Some(1)), (39, 4.0, 3.5, Some(1)), (18, 1.0, 0.0, Some(2)), (38, 3.0, 4.0, Some(2))];
    for (place, r, p, of) in contacts.into_iter().chain([(37, 9.0, 0.0, None)]) {
        (reference[place], predicted[place], kind[place]) = (r, p, of);
    }
    let mut evaluation = Evaluation::new(&force, &[]);
    evaluation.add_with_regions(&reference, &predicted, &kind).unwrap();
    let rows = evaluation.rows();
    let value = |metric: Metric, region: &str| find(&rows, metric.in_region(region), None, None).value;
    // Squared errors of 0.25 and 0.25 around the mean of 3 N, and of 1 and 1 around the mean of 2 N.
    assert_close(value(Metric::R2, "ground"), 1.0 - 0.5 / 2.0);
    assert_close(value(Metric::R2, "box"), 1.0 - 2.0 / 2.0);
    assert_close(value(Metric::Wmape, "ground"), 100.0 * 1.0 / 6.0);
    assert_close(value(Metric::Mae, "box"), 1.0);
    assert_close(value(Metric::Rmse, "none"), 0.5);
    let is_without_contact = |row: &&Row| row.metric.name().ends_with("_none") && row.direction.is_none();
    let named: Vec<&str> = rows.iter().filter(is_without_contact).map(|row| row.metric.name()).collect();
    assert_eq!(named, ["rmse_none", "mae_none"], "the force without contact is constant");
    assert_eq!(Metric::named("r2_ground"), Some(Metric::R2.in_region("ground")));
    let total = evaluate(&of_finger(Modality::CONTACT_FORCE), &reference, &predicted).unwrap();
    assert_eq!(
        find(&rows, Metric::R2, None, None),
        find(&total, Metric::R2, None, None),
        "kinds change no other row"
    );
    assert!(rows.iter().all(|row| row.index.is_none() || !matches!(row.metric, Metric::Regional(..))));
    // As those of one region, all rows that are not of an element have its name, and no row is of another region.
    let of_region = evaluation.rows_of_region("from_2s");
    let plain = rows.iter().filter(|row| row.index.is_none() && !matches!(row.metric, Metric::Regional(..)));
    let renamed = plain.map(|row| Row { metric: row.metric.in_region("from_2s"), ..row.clone() });
    assert_eq!(of_region, renamed.collect::<Vec<_>>());
    assert_eq!(Metric::named("r2_from_2s"), Some(of_region[1].metric));
}

/// The rows of forces on the finger's links, N, of which all have the same prediction at all samples.
fn of_forces(present: &[f32], reference: &[f32], predicted: &[f32], ensemble: Option<&Ensemble>) -> Vec<Row> {
    let mut evaluation = ForceEvaluation::new(&of_finger(Modality::CONTACT_FORCE));
    let seeds: Vec<u64> = (0..reference.len() as u64 / JOINTS as u64).collect();
    evaluation.add(&Forces { present, reference, predicted, ensemble, seeds: &seeds }).unwrap();
    evaluation.rows()
}

#[test]
fn the_phases_of_a_contact_have_metrics_of_their_own() {
    // Link 19 over eight samples: two onsets, two samples that go on, two releases, two without a contact.
    let of_link = |values: [f32; 8]| -> Vec<f32> {
        values
            .iter()
            .flat_map(|value| (0..JOINTS).map(move |link| if link == 19 { *value } else { 0.0 }))
            .collect()
    };
    let present = of_link([0.0, 0.05, 1.0, 2.0, 3.0, 4.0, 0.0, 0.0]);
    let reference = of_link([1.0, 3.0, 5.0, 2.0, 0.0, 0.04, 0.0, 0.01]);
    let predicted = of_link([2.0, 0.0, 5.5, 1.5, 0.5, 0.04, -1.0, 0.01]);
    let rows = of_forces(&present, &reference, &predicted, None);
    let value = |metric: Metric, part: &str| {
        find(&rows, metric.in_region(part), Some(Direction::ADDUCTION_ABDUCTION), Some(19)).value
    };
    assert_close(value(Metric::Mae, "onset"), 2.0);
    assert_close(value(Metric::Rmse, "onset"), 5.0_f64.sqrt());
    assert_close(value(Metric::Mae, "sustained"), 0.5);
    assert_close(value(Metric::Mae, "release"), 0.25);
    assert_close(value(Metric::Mae, "free"), 0.5);
    assert_close(value(Metric::Crps, "contact"), (1.0 + 3.0 + 0.5 + 0.5) / 4.0);
    // All links together have the same contacts, and 19 links without any.
    let whole = |metric: Metric| find(&rows, metric, None, None).value;
    assert_close(whole(Metric::R2.in_region("contact")), 1.0 - (1.0 + 9.0 + 0.25 + 0.25) / 8.75);
    assert_close(whole(Metric::Mae.in_region("free")), 1.0 / (2.0 + 19.0 * 8.0));
    assert_close(whole(Metric::Crps), 6.5 / 8.0);
    // Contacts are predicted at 2, 5.5, 1.5 and 0.5 N. Of the 4 times 156 pairs with and without a contact, the score
    // of 0 N is equal to 152 others' and above one, and 0.5 N is below 3.
    assert_close(whole(Metric::F1), 2.0 * 3.0 / (4.0 + 4.0));
    assert_close(whole(Metric::Auc), (3.0 * 156.0 + 1.0 + 152.0 / 2.0) / (4.0 * 156.0));
    let logarithm = |force: f64| force.ln_1p() as f32;
    let logarithms = series(&[1.0, 3.0, 5.0, 2.0].map(logarithm), &[2.0, 0.0, 5.5, 1.5].map(logarithm));
    assert_close(whole(Metric::LogR2), r2(&logarithms).unwrap());
    assert!(rows.iter().all(|row| row.index.is_none_or(|link| link == 19)), "other links are never touched");
    assert!(rows.iter().all(|row| Metric::named(row.metric.name()) == Some(row.metric)));
    assert!(!rows.iter().any(|row| row.metric.name().starts_with("coverage")), "a point has no interval");
}

#[test]
fn links_that_touch_in_one_sample_of_a_hundred_have_rows_of_their_own() {
    // Link 3 touches in 4 of 400 samples, and link 7 in 3.
    let touches = |link: usize, sample: usize| link == 3 && sample < 4 || link == 7 && sample < 3;
    let force = |place: usize| f32::from(u8::from(touches(place % JOINTS, place / JOINTS)));
    let reference: Vec<f32> = (0..400 * JOINTS).map(force).collect();
    let rows = of_forces(&reference, &reference, &reference, None);
    let mut own: Vec<u32> = rows.iter().filter_map(|row| row.index).collect();
    own.dedup();
    assert_eq!(own, [3]);
}

#[test]
fn r2_without_the_strongest_contacts_leaves_out_one_sample_of_a_hundred() {
    let mut reference: Vec<f32> = (0..200).map(|sample| (sample % 2) as f32).collect();
    let predicted = reference.iter().map(|r| r * 0.5).collect::<Vec<_>>();
    (reference[20], reference[150]) = (500.0, 700.0);
    let one = |values: &[f32]| values.iter().flat_map(|value| [*value; JOINTS]).collect::<Vec<_>>();
    let rows = of_forces(&one(&reference), &one(&reference), &one(&predicted), None);
    // 98 zeros and 100 ones are left, with an error of 0.5 at each one.
    let deviation = 98.0 * 100.0 / 198.0;
    assert_close(find(&rows, Metric::TrimmedR2, None, None).value, 1.0 - 25.0 / deviation);
    assert!(
        find(
            &evaluate(&of_finger(Modality::CONTACT_FORCE), &one(&reference), &one(&predicted)).unwrap(),
            Metric::R2,
            None,
            None
        )
        .value
        .unwrap()
            < 0.01
    );
}

#[test]
fn distributions_agree_with_scoringrules_scikit_learn_and_numpy() {
    const SIZE: usize = 37;
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    let mut force = |_| f32::max(rng.random_range(-2.0..3.0), 0.0);
    let reference: Vec<f32> = (0..50 * JOINTS).map(&mut force).collect();
    let values: Vec<f32> = (0..reference.len() * SIZE).map(&mut force).collect();
    for members in [Members::Draws, Members::Quantiles] {
        let ensemble = Ensemble::new(members, SIZE, values.clone()).unwrap();
        let expected = python(&json!({"distributions": {
            "reference": reference, "members": nested(&values, SIZE, 0..SIZE), "draws": members == Members::Draws,
        }}));
        let expected = &expected["distributions"];
        let mut covered = [0.0; 2];
        for (place, &r) in reference.iter().enumerate() {
            assert_close(ensemble.at(place).crps(r), expected["crps"][place].as_f64().unwrap());
            for (level, percent) in ["50", "90"].into_iter().enumerate() {
                let found = ensemble.at(place).interval([0.5, 0.9][level]);
                let bounds =
                    [0, 1].map(|bound| expected["intervals"][percent][bound][place].as_f64().unwrap());
                found.into_iter().zip(bounds).for_each(|(found, expected)| assert_close(found, expected));
                covered[level] += f64::from(u8::from(found[0] <= r.into() && found[1] >= r.into()));
            }
        }
        let (means, medians) = (ensemble.means(), ensemble.medians());
        let rows = of_forces(&reference, &reference, &means, Some(&ensemble));
        let value = |metric| find(&rows, metric, None, None).value;
        for (level, percent) in [50, 90].into_iter().enumerate() {
            assert_close(value(Metric::Coverage(percent)), covered[level] / reference.len() as f64);
        }
        let above = |row: &[f32]| row.iter().filter(|member| **member > 0.05).count() as f64 / SIZE as f64;
        let expected = python(&json!({"contacts": {
            "touches": reference.iter().map(|r| *r > 0.05).collect::<Vec<_>>(),
            "predicted": medians.iter().map(|median| *median > 0.05).collect::<Vec<_>>(),
            "scores": values.chunks(SIZE).map(above).collect::<Vec<_>>(),
        }}));
        assert_close(value(Metric::F1), expected["contacts"]["f1"].as_f64().unwrap());
        assert_close(value(Metric::Auc), expected["contacts"]["auc"].as_f64().unwrap());
        // The reference has the ensemble's distribution, of which 2 of 5 values are zero: PIT values are uniform.
        for bin in 0..10 {
            let share = value(Metric::Pit(bin)).unwrap();
            assert!(
                (share - 0.1).abs() < 4.0 * (0.09_f64 / reference.len() as f64).sqrt(),
                "bin {bin}: {share}"
            );
        }
        // Squared errors are those of the mean, absolute ones those of the median.
        let points = Points { mean: &means, median: &medians };
        let mut evaluation = Evaluation::new(&of_finger(Modality::CONTACT_FORCE), &[]);
        evaluation.add(&reference, points).unwrap();
        let rows = evaluation.rows();
        let whole = |metric| find(&rows, metric, None, None).value;
        assert_close(whole(Metric::Rmse), rmse(&series(&reference, &means)).unwrap());
        assert_close(whole(Metric::Mae), mae(&series(&reference, &medians)).unwrap());
    }
}

#[test]
fn given_a_contact_the_right_distribution_covers_what_it_promises() {
    const SIZE: usize = 100;
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let (mut reference, mut members) = (Vec::new(), Vec::new());
    for _ in 0..400 * JOINTS {
        // A link touches with a known probability, and the force is then uniform from 1 to 11 N.
        let touches = rng.random_range(0.0..1.0_f64).powi(3);
        let force = |share: f64| if share < 0.0 { 0.0 } else { (1.0 + 10.0 * share) as f32 };
        let quantile = |probability: f64| force((probability - 1.0 + touches) / touches);
        members.extend((0..SIZE).map(|i| quantile((i as f64 + 0.5) / SIZE as f64)));
        reference.push(quantile(rng.random_range(0.0..1.0)));
    }
    let ensemble = Ensemble::new(Members::Quantiles, SIZE, members).unwrap();
    let rows = of_forces(&reference, &reference, &ensemble.means(), Some(&ensemble));
    let value = |metric: Metric| find(&rows, metric.in_region("contact"), None, None).value.unwrap();
    let contacts: Vec<usize> = (0..reference.len()).filter(|place| reference[*place] > 0.05).collect();
    let within = |share: f64| 4.0 * (share * (1.0 - share) / contacts.len() as f64).sqrt();
    for percent in [50, 90] {
        let share = f64::from(percent) / 100.0;
        let coverage = value(Metric::Coverage(percent));
        assert!((coverage - share).abs() < within(share), "{percent} %: {coverage}");
    }
    for bin in 0..10 {
        assert!((value(Metric::Pit(bin)) - 0.1).abs() < within(0.1), "bin {bin}");
    }
    // The whole distribution's interval leaves out more contacts, because unlikely ones are above it.
    let covers = |place: &&usize| ensemble.at(**place).interval(0.9)[1] >= f64::from(reference[**place]);
    let whole = contacts.iter().filter(covers).count() as f64 / contacts.len() as f64;
    assert!((0.8..0.87).contains(&whole), "{whole}");
}

#[test]
fn a_reference_is_placed_among_draws() {
    let ensemble = Ensemble::new(Members::Draws, 4, vec![4.0, 2.0, 1.0, 2.0]).unwrap();
    let draws = ensemble.at(0);
    // One of four is smaller, and two are equal, so that there are three places among five.
    assert_eq!([draws.pit(2.0, 0.0), draws.pit(2.0, 1.0)], [1.0 / 5.0, 4.0 / 5.0]);
    assert_eq!([draws.pit(3.0, 0.5), draws.pit(0.0, 0.0), draws.pit(9.0, 1.0)], [3.5 / 5.0, 0.0, 1.0]);
    assert_eq!([0.0, 1.0, 2.0, 4.0].map(|threshold| draws.above(threshold)), [1.0, 0.75, 0.25, 0.0]);
}

#[test]
fn one_member_is_a_point() {
    for (reference, member) in [(0.0, 0.0), (1.5, 4.0), (3.0, -2.5)] {
        for members in [Members::Draws, Members::Quantiles] {
            let ensemble = Ensemble::new(members, 1, vec![member]).unwrap();
            assert_eq!(ensemble.at(0).crps(reference), f64::from((reference - member).abs()));
            assert_eq!((ensemble.means()[0], ensemble.medians()[0]), (member, member));
        }
    }
    assert!(Ensemble::new(Members::Draws, 2, vec![1.0; 3]).is_err());
    assert!(Ensemble::new(Members::Draws, 0, Vec::new()).is_err());
    assert!(Ensemble::new(Members::Draws, 1, vec![f32::NAN]).is_err());
}

#[test]
fn a_pixel_counts_for_what_it_shows_before_or_after_the_change() {
    const PLANE: usize = FRAME_SIDE * FRAME_SIDE;
    let [ground, arm, finger] = [[216, 216, 208], [40, 44, 52], [180, 120, 10]];
    let frame = |pixels: [[u8; 3]; 4]| {
        let mut frame: Vec<u8> = ground.into_iter().flat_map(|value| [value; PLANE]).collect();
        for (pixel, color) in pixels.into_iter().enumerate() {
            (0..3).for_each(|channel| frame[channel * PLANE + pixel] = color[channel]);
        }
        frame
    };
    let (before, after) = (frame([ground, arm, finger, arm]), frame([ground, ground, ground, finger]));
    let regions = &Layout::finger().regions;
    let (arm, finger) = (region_of(regions, arm), region_of(regions, finger));
    assert_eq!((arm, finger), (Some(0), Some(1)));
    let either = |before: &[u8], after: &[u8]| in_either(before, after, |pixel| region_of(regions, pixel));
    assert_eq!(either(&before, &after)[..5], [None, arm, finger, finger, None]);
    assert_eq!(either(&after, &before)[..5], [None, arm, finger, finger, None]);
    // Pixels of a segmentation have one of its colors, or show no class.
    let colors = [[0, 0, 0], [0, 255, 0], [255, 255, 255], [254, 0, 0]];
    assert_eq!(colors.map(class_of), [None, Some(1), Some(6), None]);
}

#[test]
fn vision_is_compared_with_the_mean_picture() {
    let (reference, _) = random_pairs(7, 4 * FRAME_LEN, 0.5);
    let mut mean = TrainingMean::new(FRAME_LEN);
    mean.add(&reference).unwrap();
    let rows = evaluate(&of_finger(Modality::VISION), &reference, &mean.predict(4).unwrap()).unwrap();
    let relative_error = find(&rows, Metric::RelativeError, None, None).value.unwrap();
    assert!((relative_error - 1.0).abs() < 1e-6, "{relative_error}");
}

#[test]
fn batches_add_up_to_the_whole() {
    let (reference, predicted) = random_pairs(8, 50 * JOINTS, 0.0);
    let mut evaluation = Evaluation::new(&of_finger(Modality::PROPRIOCEPTION), &[]);
    for (reference, predicted) in reference.chunks(7 * JOINTS).zip(predicted.chunks(7 * JOINTS)) {
        evaluation.add(reference, predicted).unwrap();
    }
    assert_eq!(
        evaluation.rows(),
        evaluate(&of_finger(Modality::PROPRIOCEPTION), &reference, &predicted).unwrap()
    );
}

#[test]
fn bad_batches_are_refused_and_add_nothing() {
    let good = vec![1.0; 2 * JOINTS];
    let mut evaluation = Evaluation::new(&of_finger(Modality::PROPRIOCEPTION), &[]);
    evaluation.add(&good, &good).unwrap();
    let before = evaluation.rows();

    let error = evaluation.add(&good[1..], &good).unwrap_err();
    assert!(error.to_string().starts_with("the reference has 39 values, not a whole number of rows of 20;"));
    let error = evaluation.add(&good, &good[..JOINTS]).unwrap_err();
    assert_eq!(
        error.to_string(),
        "the reference has 2 samples and the prediction has 1; both must cover the same samples"
    );
    let mut diverged = good.clone();
    diverged[JOINTS + 3] = f32::NAN;
    let error = evaluation.add(&good, &diverged).unwrap_err();
    assert!(error.to_string().starts_with("the prediction is NaN at row 1, column 3"), "{error}");
    diverged[JOINTS + 3] = f32::INFINITY;
    assert!(evaluation.add(&diverged, &good).is_err());

    assert_eq!(evaluation.rows(), before);
}

// --- baselines ---

#[test]
fn persistence_repeats_what_is_sensed() {
    let now = [0.1, -0.2, 0.3];
    assert_eq!(persistence(&of_finger(Modality::ARM), &now)[..], now);
    assert_eq!(persistence(&of_finger(Modality::FRAME_DIFFERENCE), &now)[..], [0.0; 3]);
}

#[test]
fn training_mean_is_predicted_for_every_sample() {
    let mut mean = TrainingMean::new(2);
    let error = mean.predict(1).unwrap_err();
    assert_eq!(error.to_string(), "the training mean has no training samples; add at least one");
    mean.add(&[1.0, 10.0, 2.0, 20.0]).unwrap();
    mean.add(&[6.0, 0.0]).unwrap();
    assert!(mean.add(&[1.0]).is_err() && mean.add(&[f32::NAN, 0.0]).is_err());
    assert_eq!(mean.predict(2).unwrap(), [3.0, 10.0, 3.0, 10.0]);
}

#[test]
fn ridge_gives_hand_worked_weights() {
    // For centered values Σ x y = 3 and Σ x² = 2, so the coefficient is 3 / (2 + alpha).
    let (x, y) = ([-1.0, 0.0, 1.0], [1.0, 2.0, 4.0]);
    let ridge = Ridge::fit(&x, 1, &y, 1, 1.0).unwrap();
    let (intercept, coefficients) = ridge.weights(0);
    assert_close(intercept, 7.0 / 3.0);
    assert_close(coefficients[0], 1.0);
    assert_eq!(ridge.predict(&[2.0, 0.0]).unwrap(), [13.0 / 3.0, 7.0 / 3.0]);
    let (intercept, coefficients) =
        Ridge::fit(&x, 1, &y, 1, 0.0).map(|r| (r.weights(0).0, r.weights(0).1[0])).unwrap();
    assert_close(intercept, 7.0 / 3.0);
    assert_close(coefficients, 1.5);
}

#[test]
fn ridge_agrees_with_scikit_learn() {
    const INPUTS: usize = 7;
    const OUTPUTS: usize = 3;
    const ALPHA: f64 = 2.5;
    let samples = 600; // more than are turned to f64 at a time
    let (x, noise) = random_pairs(9, samples * INPUTS, 0.3);
    let y: Vec<f32> = x
        .chunks_exact(INPUTS)
        .zip(noise.chunks_exact(INPUTS))
        .flat_map(|(x, noise)| [x[0] - 2.0 * x[3] + noise[1], 40.0 * noise[2], 5.0 + x[6] * noise[4]])
        .collect();
    let ridge = Ridge::fit(&x, INPUTS, &y, OUTPUTS, ALPHA).unwrap();
    let answer = python(&json!({"ridge": {
        "x": nested(&x, INPUTS, 0..INPUTS), "y": nested(&y, OUTPUTS, 0..OUTPUTS), "alpha": ALPHA
    }}));
    let predicted = ridge.predict(&x).unwrap();
    for output in 0..OUTPUTS {
        let (intercept, coefficients) = ridge.weights(output);
        assert_close(intercept, answer["ridge"]["intercept"][output].as_f64().unwrap());
        for (input, &coefficient) in coefficients.iter().enumerate() {
            assert_close(coefficient, answer["ridge"]["coefficients"][output][input].as_f64().unwrap());
        }
        for (x, predicted) in x.chunks_exact(INPUTS).zip(predicted.chunks_exact(OUTPUTS)) {
            let expected: f64 = coefficients.iter().zip(x).map(|(w, &x)| w * f64::from(x)).sum();
            assert!((f64::from(predicted[output]) - intercept - expected).abs() < 1e-5);
        }
    }
}

#[test]
fn ridge_fits_batches_as_the_whole() {
    let (x, y) = random_pairs(10, 400, 0.0);
    let mut sums = RidgeSums::new(4, 2);
    for (x, y) in x.chunks(36).zip(y[..200].chunks(18)) {
        sums.add(x, y).unwrap();
    }
    let (whole, batches) = (Ridge::fit(&x, 4, &y[..200], 2, 0.1).unwrap(), sums.solve(0.1).unwrap());
    for output in 0..2 {
        assert_close(batches.weights(output).0, whole.weights(output).0);
        for (batch, whole) in batches.weights(output).1.iter().zip(whole.weights(output).1) {
            assert_close(*batch, *whole);
        }
    }
}

#[test]
fn ridge_refuses_what_has_no_answer() {
    let (x, y) = ([1.0, 2.0, 2.0, 4.0, 3.0, 6.0], [1.0, 2.0, 3.0]);
    let fit = |alpha| Ridge::fit(&x, 2, &y, 1, alpha);
    let refused = |fitted: Result<Ridge, MetricsError>| fitted.unwrap_err().to_string();
    assert!(refused(fit(0.0)).contains("linearly dependent at column 1 and alpha is 0;"));
    assert!(fit(1e-3).is_ok());
    assert!(refused(fit(-1.0)).contains("alpha is -1;"));
    assert!(fit(f64::NAN).is_err());
    // A constant input is collinear with the intercept.
    let constant = Ridge::fit(&[0.5, 0.5, 0.5], 1, &y, 1, 0.0);
    assert!(refused(constant).contains("linearly dependent at column 0 and alpha is 0;"));
    assert!(refused(RidgeSums::new(2, 1).solve(1.0)).starts_with("ridge regression has no training samples"));
    assert!(Ridge::fit(&x, 2, &y[..2], 1, 1.0).is_err());
    assert!(Ridge::fit(&[f32::NAN; 6], 2, &y, 1, 1.0).is_err());
    assert!(fit(1.0).unwrap().predict(&x[..3]).is_err());
}

#[test]
fn downsampling_averages_blocks_of_pixels() {
    const BLOCK: usize = FRAME_SIDE / GRAY_SIDE;
    let mut frame = vec![10.0; FRAME_LEN];
    // The whole block in row 2, column 15 is changed, and one channel of one pixel of the block in row 0, column 1.
    for channel in frame.chunks_exact_mut(FRAME_SIDE * FRAME_SIDE) {
        for row in 2 * BLOCK..3 * BLOCK {
            channel[row * FRAME_SIDE + 15 * BLOCK..][..BLOCK].fill(255.0);
        }
    }
    frame[BLOCK] = 10.0 + 48.0;
    let gray = downsample_frame(&frame, [FRAME_SIDE; 2]).unwrap();
    let mut expected = [10.0; GRAY_SIDE * GRAY_SIDE];
    expected[2 * GRAY_SIDE + 15] = 255.0;
    expected[1] = 11.0;
    assert_eq!(gray, expected);
    assert!(downsample_frame(&frame[1..], [FRAME_SIDE; 2]).is_err());
}

#[test]
fn contact_forces_are_summed_up_link_by_link() {
    // The force on link 3 is 0, 1, 2, …, 10 N. The force on link 5 is 4 N once. All other forces are 0.
    let mut forces = vec![0.0; 11 * JOINTS];
    (0..11).for_each(|sample| forces[sample * JOINTS + 3] = sample as f32);
    forces[7 * JOINTS + 5] = 4.0;
    let links = by_link(&forces, JOINTS);
    assert_eq!(links.len(), JOINTS);
    // The quantile p of 1 to 10 at equal distances is 1 + 9 p.
    let quantiles = [0.05, 0.25, 0.5, 0.75, 0.95].map(|share| 1.0 + 9.0 * share);
    let Contact { samples, contacts, mean, quantiles: found, max } = links[3].clone();
    assert_eq!((samples, contacts, mean, max), (11, 10, 5.0, Some(10.0)));
    for (found, expected) in found.unwrap().into_iter().zip(quantiles) {
        assert_close(found, expected);
    }
    assert_eq!((links[5].contacts, links[5].quantiles), (1, Some([4.0; 5])));
    // Adhesion pulls.
    assert_eq!(by_link(&[-1.0, 0.0, 2.0], 1)[0].contacts, 2);
    let untouched = Contact { samples: 11, contacts: 0, mean: 0.0, quantiles: None, max: None };
    assert_eq!(links[0], untouched);
    assert_eq!(by_link(&[], JOINTS)[0], Contact { samples: 0, ..untouched });
}

#[test]
fn the_skill_is_one_minus_the_ratio_of_squared_errors() {
    use harness_metrics::skill::{skill, skill_horizon};
    // 1 - 1 / 4, and 1 - 9 / 4.
    assert_eq!([skill(1.0, 2.0), skill(2.0, 2.0), skill(3.0, 2.0)], [Some(0.75), Some(0.0), Some(-1.25)]);
    assert_eq!([skill(0.0, 2.0), skill(1.0, 0.0)], [Some(1.0), None]);
    let skills = [(1, 0.5), (2, 0.1), (5, 0.0), (10, 0.3)];
    assert_eq!([skill_horizon(skills), skill_horizon(skills.into_iter().take(2))], [2, 2]);
    assert_eq!([skill_horizon(skills.into_iter().skip(2)), skill_horizon([])], [0, 0]);
    for metric in Metric::DERIVED {
        assert_eq!((Metric::named(metric.name()), metric.higher_is_better()), (Some(metric), true));
    }
}
