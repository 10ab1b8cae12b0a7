//! Networks that predict categories or unit vectors.

use super::*;
use harness_learning::network::description::FORMAT_WITH_CATEGORIES;
use harness_ops::{categorical_cross_entropy, cosine_losses};

/// The modality whose elements are categories in these tests.
const CATEGORY: Modality = Modality::ARM;

/// The finger's layout, in which the elements of the arm are categories.
fn layout() -> Arc<Layout> {
    let mut layout = Layout::clone(&Layout::finger());
    layout.modalities.iter_mut().filter(|own| own.name == CATEGORY).for_each(|own| own.category = true);
    Arc::new(layout)
}

/// The elements of samples of these categories.
fn one_hot(categories: &[usize]) -> Tensor {
    let elements = |category: usize| (0..ARM_JOINTS).map(move |place| f32::from(u8::from(place == category)));
    let values: Vec<f32> = categories.iter().copied().flat_map(elements).collect();
    Tensor::from_vec(values, (categories.len(), ARM_JOINTS), &Device::Cpu).unwrap()
}

#[test]
fn the_cross_entropy_is_minus_the_logarithm_of_the_probability_of_the_category() {
    let mut random = random(1);
    let target = one_hot(&[2, 0, 1, 1]);
    let logits = variable(&mut random, &[4, ARM_JOINTS]);
    assert_gradients(&[logits], |logits| categorical_cross_entropy(&logits[0], &target));
    // The probabilities are 1/8, 2/8 and 5/8. A number that all logits share changes nothing, also a large one.
    for added in [0.0, 1e4] {
        let logits = [1f32, 2.0, 5.0].map(|weight| weight.ln() + added);
        let logits = Tensor::new(&[logits; 3], &Device::Cpu).unwrap();
        let losses = categorical_cross_entropy(&logits, &one_hot(&[0, 1, 2])).unwrap();
        for (found, share) in losses.to_vec1::<f32>().unwrap().into_iter().zip([0.125f32, 0.25, 0.625]) {
            assert!((found + share.ln()).abs() < 2e-3, "{found} {share}");
        }
    }
}

#[test]
fn a_decoder_predicts_probabilities_and_is_trained_by_their_cross_entropy() {
    let bench = Bench::new();
    let output = vec![CATEGORY, Modality::CONTACT_FORCE];
    let architecture = Architecture { layout: layout(), output, ..bench.architecture() };
    let (mut parameters, mut random) = (Parameters::new(), random(3));
    let decoder = architecture.decoder(&mut parameters, &mut random, &Device::Cpu).unwrap();
    let (latent, action) = (normal(&mut random, &[4, 3]), normal(&mut random, &[4, ARM_JOINTS]));
    let probabilities = decoder.decode(&latent, Some(&action)).unwrap().remove(&CATEGORY).unwrap();
    let probabilities = probabilities.to_vec2::<f32>().unwrap();
    for row in &probabilities {
        assert!(row.iter().all(|share| (0.0..=1.0).contains(share)));
        assert!((row.iter().sum::<f32>() - 1.0).abs() < 1e-6);
    }
    let categories = [2, 0, 1, 1];
    let forces = normal(&mut random, &[4, JOINTS]);
    let values = [(CATEGORY, one_hot(&categories)), (Modality::CONTACT_FORCE, forces)];
    let values: Observation =
        values.into_iter().map(|(name, tensor)| (name, Value::Vector(tensor))).collect();
    let targets =
        Targets { values: &values, losses: &BTreeMap::new(), parts: 2, score: Score::Loss, added: None };
    let terms = decoder.losses(&latent, Some(&action), targets).unwrap();
    let found = terms.iter().find(|term| term.modality == CATEGORY).unwrap().value.to_vec1::<f32>().unwrap();
    let loss = |row: usize| -probabilities[row][categories[row]].ln();
    for (part, found) in found.into_iter().enumerate() {
        assert!((found - (loss(2 * part) + loss(2 * part + 1)) / 2.0).abs() < 1e-5, "part {part}");
    }
    let description = Description::new(
        &architecture,
        Task::Prediction,
        Action::Increment,
        &BTreeMap::new(),
        &bench.data.normalizers,
        &Window::TRANSITION,
    );
    let description = description.unwrap();
    assert_eq!(description.format, FORMAT_WITH_CATEGORIES);
    let outputs: Vec<_> = description.outputs.iter().map(|output| (output.loss, output.softmax)).collect();
    assert_eq!(outputs, [("cross_entropy", true), ("squared", false)]);
}

#[test]
fn a_direction_is_trained_by_its_cosine_where_there_is_one() {
    let target =
        Tensor::new(&[[1f32, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.6, 0.8, 0.0, -1.0, 0.0]], &Device::Cpu);
    let target = target.unwrap();
    let predicted = variable(&mut random(5), &[2, 6]);
    assert_gradients(&[predicted], |predicted| cosine_losses(&predicted[0], &target)?.sum_all());
    // A right angle, nothing to predict, the right direction with another length, and the opposite one.
    let predicted = [[0f32, 3.0, 0.0, 7.0, 7.0, 7.0], [0.0, 1.2, 1.6, 0.0, 5.0, 0.0]];
    let predicted = Tensor::new(&predicted, &Device::Cpu).unwrap();
    let losses = cosine_losses(&predicted, &target).unwrap();
    for (found, expected) in
        losses.flatten_all().unwrap().to_vec1::<f32>().unwrap().iter().zip([1.0, 0.0, 0.0, 2.0])
    {
        assert!((found - expected).abs() < 1e-6, "{found} {expected}");
    }
}

#[test]
fn the_loss_of_unit_vectors_does_not_depend_on_where_there_are_none() {
    let bench = Bench::new();
    let mut layout = Layout::clone(&Layout::finger());
    layout.modalities.iter_mut().filter(|own| own.name == CATEGORY).for_each(|own| own.unit_vectors = true);
    let architecture =
        Architecture { layout: Arc::new(layout), output: vec![CATEGORY], ..bench.architecture() };
    let (mut parameters, mut random) = (Parameters::new(), random(3));
    let decoder = architecture.decoder(&mut parameters, &mut random, &Device::Cpu).unwrap();
    let (latent, action) = (normal(&mut random, &[4, 3]), normal(&mut random, &[4, ARM_JOINTS]));
    let predicted = decoder.decode(&latent, Some(&action)).unwrap().remove(&CATEGORY).unwrap();
    let predicted = predicted.to_vec2::<f32>().unwrap();
    // One of two samples has a direction, with a normalized length of √2. The second part has no direction at all.
    let target = [[0f32, 0.0, 2f32.sqrt()], [0.0; 3], [0.0; 3], [0.0; 3]];
    let value = Value::Vector(Tensor::new(&target, &Device::Cpu).unwrap());
    let values: Observation = [(CATEGORY, value)].into_iter().collect();
    let targets =
        Targets { values: &values, losses: &BTreeMap::new(), parts: 2, score: Score::Loss, added: None };
    let terms = decoder.losses(&latent, Some(&action), targets).unwrap();
    let length = predicted[0].iter().map(|value| value * value).sum::<f32>().sqrt();
    let found = terms[0].value.to_vec1::<f32>().unwrap();
    assert!((found[0] - (1.0 - predicted[0][2] / length)).abs() < 1e-5 && found[1] == 0.0, "{found:?}");
}
