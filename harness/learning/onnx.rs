//! Trained networks as ONNX models, from their descriptions.
//!
//! A model takes and returns SI units and bytes, as users have them. Normalization is part of its graph. The batch is
//! the first axis, of any size. The format: <https://github.com/onnx/onnx/blob/main/onnx/onnx.proto3>.

use crate::LearningError;
use crate::network::description::{
    ACTION, Activation, Convolution, Description, IMAGES, LATENT, Layer, Operation, Output, POSTERIOR,
    Quantity, Scale, VECTORS,
};
use crate::tensors::TensorFile;
use harness_spec::{Element, Kind, Task};
use prost::Message;
use proto::{Attribute, Graph, Model, Node, Property, Tensor, ValueInfo};

/// Version of the file format (ONNX 1.12), which has the operators of [`OPERATORS`].
const FILE: i64 = 8;
/// Version of the operators. It is the first one with layer normalization.
const OPERATORS: i64 = 17;
/// Name of the first axis, whose size is not fixed.
const BATCH: &str = "batch";
/// Names of the outputs with the posterior of the latent state.
const MEAN: &str = "latent.mean";
const LOG_VARIANCE: &str = "latent.log_variance";

/// A network file with its description.
pub struct Described {
    /// The description.
    pub description: Description,
    /// The tensors.
    pub file: TensorFile,
}

/// Returns the bytes of an ONNX model that applies the encoder of `prediction` and the decoder of `decoding`, which may
/// be the same network or a reconstruction. Inputs have the names of their modalities, and outputs too, after
/// `predicted.` or `reconstructed.`. `properties` are stored in the model, next to its description.
///
/// # Errors
/// When a tensor is missing.
pub fn model(
    prediction: &Described,
    decoding: &Described,
    properties: &[(&str, &str)],
) -> Result<Vec<u8>, LearningError> {
    let mut graph = Writer { tensors: &prediction.file, graph: Graph::default() };
    let (encoding, decoder) = (&prediction.description, &decoding.description);
    for input in &encoding.inputs {
        graph.input(input)?;
    }
    for value in [VECTORS, IMAGES] {
        let parts = encoding.inputs.iter().filter(|input| input.value == value);
        let parts: Vec<String> = parts.map(|input| normalized(input.name.name())).collect();
        if !parts.is_empty() {
            graph.node("Concat", &parts, in_part("encoder", value), vec![Attribute::int("axis", 1)]);
        }
    }
    graph.layers("encoder", &encoding.encoder)?;
    graph.posterior(encoding.latent);
    graph.tensors = &decoding.file;
    if let Some(action) = &decoder.action {
        graph.declare(
            ACTION,
            proto::FLOAT,
            &[action.elements.len()],
            format!("{}: {}", action.form, units(&action.elements)),
        );
        graph.normalize(ACTION, ACTION, &action.scale, &[action.elements.len()])?;
        graph.node("Identity", &[normalized(ACTION)], in_part("decoder", ACTION), Vec::new());
    }
    graph.layers("decoder", &decoder.decoder)?;
    let prefix = if decoder.task == Task::Prediction.name() { "predicted" } else { "reconstructed" };
    for output in &decoder.outputs {
        graph.output(prefix, output)?;
    }
    graph.graph.name = decoder.task.to_owned();
    let description = decoder.json();
    let described = [("network", description.as_str())];
    let properties = properties.iter().chain(&described);
    Ok(Model {
        ir_version: FILE,
        producer_name: "harness".into(),
        producer_version: env!("CARGO_PKG_VERSION").into(),
        graph: Some(graph.graph),
        operators: vec![proto::OperatorSet { domain: String::new(), version: OPERATORS }],
        properties: properties
            .map(|(key, value)| Property { key: (*key).to_owned(), value: (*value).to_owned() })
            .collect(),
    }
    .encode_to_vec())
}

/// Returns the name of a value of the encoder or the decoder. Values that both have keep the names of the outputs.
fn in_part(part: &str, value: &str) -> String {
    if value == LATENT { MEAN.to_owned() } else { format!("{part}.{value}") }
}

fn normalized(name: &str) -> String {
    format!("{name}.normalized")
}

/// Lists elements with their units: `rotation (rad), lift (m)`.
fn units(elements: &[Element]) -> String {
    let listed = elements.iter().map(|element| match element.unit.as_str() {
        "" => element.name.clone(),
        unit => format!("{} ({unit})", element.name),
    });
    listed.collect::<Vec<_>>().join(", ")
}

/// Describes a modality's values for users of the model.
fn told(quantity: &Quantity) -> String {
    let values = match &quantity.kind {
        Kind::Vector { elements } => units(elements),
        Kind::Image { .. } if quantity.difference_of.is_some() => "rows, columns, RGB, in [-1, 1]".into(),
        Kind::Image { .. } => "rows, columns, RGB".into(),
    };
    format!("{}: {values}", quantity.meaning)
}

/// Shape of a modality in the network, without the batch.
fn inner_shape(quantity: &Quantity) -> Vec<usize> {
    match quantity.shape.as_slice() {
        [rows, columns, channels] => vec![*channels, *rows, *columns],
        shape => shape.to_vec(),
    }
}

/// Adds nodes to a graph. Constants come from `tensors`.
struct Writer<'a> {
    tensors: &'a TensorFile,
    graph: Graph,
}

impl Writer<'_> {
    /// Adds a node with one output, and returns the output's name.
    fn node(
        &mut self,
        operator: &str,
        inputs: &[impl ToString],
        output: String,
        attributes: Vec<Attribute>,
    ) -> String {
        self.graph.nodes.push(Node {
            inputs: inputs.iter().map(ToString::to_string).collect(),
            outputs: vec![output.clone()],
            name: output.clone(),
            operator: operator.into(),
            attributes,
        });
        output
    }

    /// Adds a tensor of the network's file as a constant, with `shape`, or its own if `None`, and returns its name.
    fn tensor(&mut self, name: &str, shape: Option<&[usize]>) -> Result<String, LearningError> {
        if self.graph.constants.iter().all(|constant| constant.name != name) {
            let found = self.tensors.tensors.get(name);
            let tensor = found
                .ok_or_else(|| candle_core::Error::Msg(format!("the network has no tensor '{name}'")))?;
            let values: Vec<f32> = tensor.flatten_all()?.to_vec1()?;
            self.graph.constants.push(Tensor::floats(name, shape.unwrap_or(tensor.dims()), &values));
        }
        Ok(name.to_owned())
    }

    /// Adds whole numbers as a constant and returns its name.
    fn numbers(&mut self, name: String, values: &[usize]) -> String {
        self.graph.constants.push(Tensor::numbers(&name, values));
        name
    }

    /// Adds a number as a constant and returns its name.
    fn number(&mut self, name: String, value: f32) -> String {
        self.graph.constants.push(Tensor::floats(&name, &[], &[value]));
        name
    }

    /// Declares an input of the model.
    fn declare(&mut self, name: &str, kind: i32, shape: &[usize], told: String) {
        self.graph.inputs.push(ValueInfo::batch(name, kind, shape, told));
    }

    /// Declares an input modality and normalizes it.
    fn input(&mut self, quantity: &Quantity) -> Result<(), LearningError> {
        let name = quantity.name.name();
        let bytes = matches!(quantity.kind, Kind::Image { .. }) && quantity.difference_of.is_none();
        let kind = if bytes { proto::UINT8 } else { proto::FLOAT };
        self.declare(name, kind, &quantity.shape, told(quantity));
        let mut value = name.to_owned();
        if bytes {
            let float = Attribute::int("to", proto::FLOAT.into());
            value = self.node("Cast", &[value], format!("{name}.float"), vec![float]);
            let most = self.number(format!("{name}.bytes"), 255.0);
            value = self.node("Div", &[value, most], format!("{name}.unit"), Vec::new());
        }
        if matches!(quantity.kind, Kind::Image { .. }) {
            let order = Attribute::ints("perm", &[0, 3, 1, 2]);
            value = self.node("Transpose", &[value], format!("{name}.planes"), vec![order]);
        }
        self.normalize(name, &value, &quantity.scale, &inner_shape(quantity))
    }

    /// Normalizes `value`, the quantity `name`.
    fn normalize(
        &mut self,
        name: &str,
        value: &str,
        scale: &Scale,
        shape: &[usize],
    ) -> Result<(), LearningError> {
        let mean = self.tensor(&scale.mean, Some(shape))?;
        let deviation = self.tensor(&scale.deviation, None)?;
        let centred = self.node("Sub", &[value, &mean], format!("{name}.centred"), Vec::new());
        self.node("Div", &[centred, deviation], normalized(name), Vec::new());
        Ok(())
    }

    /// Splits the posterior, and declares both halves as outputs.
    fn posterior(&mut self, latent: usize) {
        let sizes = self.numbers("latent.sizes".into(), &[latent, latent]);
        let outputs = vec![MEAN.to_owned(), LOG_VARIANCE.to_owned()];
        self.graph.nodes.push(Node {
            inputs: vec![in_part("encoder", POSTERIOR), sizes],
            outputs: outputs.clone(),
            name: "latent".into(),
            operator: "Split".into(),
            attributes: vec![Attribute::int("axis", 1)],
        });
        for (name, told) in outputs.iter().zip(["mean", "logarithm of the variance"]) {
            let told = format!("The posterior's {told} of the latent state");
            self.graph.outputs.push(ValueInfo::batch(name, proto::FLOAT, &[latent], told));
        }
    }

    /// Converts a modality that the decoder has computed to SI units, and declares it as an output.
    fn output(
        &mut self,
        prefix: &str,
        Output { quantity, minimum, .. }: &Output,
    ) -> Result<(), LearningError> {
        let name = format!("{prefix}.{}", quantity.name);
        let shape = inner_shape(quantity);
        let start = self.numbers(format!("{name}.start"), &[quantity.start]);
        let end = self.numbers(format!("{name}.end"), &[quantity.start + shape[0]]);
        let axis = self.numbers(format!("{name}.axis"), &[1]);
        let from = in_part("decoder", quantity.value);
        let mut value =
            self.node("Slice", &[from, start, end, axis], format!("{name}.normalized"), Vec::new());
        let mean = self.tensor(&quantity.scale.mean, Some(&shape))?;
        let deviation = self.tensor(&quantity.scale.deviation, None)?;
        value = self.node("Mul", &[value, deviation], format!("{name}.scaled"), Vec::new());
        value = self.node("Add", &[value, mean], format!("{name}.shifted"), Vec::new());
        if let Some(minimum) = minimum {
            let minimum = self.number(format!("{name}.minimum"), *minimum as f32);
            value = self.node("Max", &[value, minimum], format!("{name}.bounded"), Vec::new());
        }
        let image = matches!(quantity.kind, Kind::Image { .. });
        let order = Attribute::ints("perm", &[0, 2, 3, 1]);
        let (operator, attributes) =
            if image { ("Transpose", vec![order]) } else { ("Identity", Vec::new()) };
        self.node(operator, &[value], name.clone(), attributes);
        self.graph.outputs.push(ValueInfo::batch(&name, proto::FLOAT, &quantity.shape, told(quantity)));
        Ok(())
    }

    /// Adds the layers of the encoder or the decoder.
    fn layers(&mut self, part: &str, layers: &[Layer]) -> Result<(), LearningError> {
        for layer in layers {
            self.layer(part, layer)?;
        }
        Ok(())
    }

    fn layer(&mut self, part: &str, layer: &Layer) -> Result<(), LearningError> {
        let output = in_part(part, &layer.name);
        let inputs: Vec<String> = layer.inputs.iter().map(|input| in_part(part, input)).collect();
        match &layer.operation {
            Operation::Concatenate => {
                self.node("Concat", &inputs, output, vec![Attribute::int("axis", 1)]);
            }
            Operation::Average { size } => {
                let sides = [*size as i64; 2];
                let attributes =
                    vec![Attribute::ints("kernel_shape", &sides), Attribute::ints("strides", &sides)];
                self.node("AveragePool", &inputs, output, attributes);
            }
            Operation::Flatten => {
                self.node("Flatten", &inputs, output, vec![Attribute::int("axis", 1)]);
            }
            Operation::Reshape => {
                // A 0 keeps the size of the batch.
                let shape =
                    self.numbers(format!("{output}.shape"), &[&[0], layer.output.as_slice()].concat());
                self.node("Reshape", &[&inputs[0], &shape], output, Vec::new());
            }
            Operation::Dense { weights, bias, activation } => {
                let mut sum = self.tensor(bias, None)?;
                for (index, (input, weight)) in inputs.iter().zip(weights).enumerate() {
                    let weight = self.tensor(weight, None)?;
                    let name = self.before(&output, *activation, index + 1 == weights.len(), index);
                    sum = self.node("Gemm", &[input, &weight, &sum], name, vec![Attribute::int("transB", 1)]);
                }
                self.activate(sum, output, *activation);
            }
            Operation::Convolution(convolution) => self.convolution("Conv", &inputs, output, convolution)?,
            Operation::TransposedConvolution(convolution) => {
                self.convolution("ConvTranspose", &inputs, output, convolution)?;
            }
            Operation::GatedRecurrentUnit { .. } => {
                let problem = "a network with memory can't be written as an ONNX model";
                return Err(candle_core::Error::Msg(problem.into()).into());
            }
            Operation::LayerNormalization { weight, bias, epsilon } => {
                let (weight, bias) = (self.tensor(weight, None)?, self.tensor(bias, None)?);
                let attributes =
                    vec![Attribute::int("axis", -1), Attribute::float("epsilon", *epsilon as f32)];
                self.node("LayerNormalization", &[&inputs[0], &weight, &bias], output, attributes);
            }
        }
        Ok(())
    }

    fn convolution(
        &mut self,
        operator: &str,
        inputs: &[String],
        output: String,
        Convolution { weight, bias, stride, padding, activation }: &Convolution,
    ) -> Result<(), LearningError> {
        let (weight, bias) = (self.tensor(weight, None)?, self.tensor(bias, None)?);
        let attributes = vec![
            Attribute::ints("strides", &[*stride as i64; 2]),
            Attribute::ints("pads", &[*padding as i64; 4]),
        ];
        let name = self.before(&output, *activation, true, 0);
        let sum = self.node(operator, &[&inputs[0], &weight, &bias], name, attributes);
        self.activate(sum, output, *activation);
        Ok(())
    }

    /// Returns the name of a layer's sum: the layer's own name if it is the last one and no activation follows.
    fn before(&self, output: &str, activation: Activation, last: bool, index: usize) -> String {
        if last && activation == Activation::None {
            output.to_owned()
        } else {
            format!("{output}.sum{index}")
        }
    }

    /// Adds the activation after `sum`, if there is one.
    fn activate(&mut self, sum: String, output: String, activation: Activation) {
        if activation == Activation::Relu {
            self.node("Relu", &[sum], output, Vec::new());
        }
    }
}

/// The messages of ONNX that a network needs, with the fields that it needs. A model without `f`, `i` or `dim` is not
/// the same as one with 0 there, so these are optional.
mod proto {
    /// Type of 32-bit numbers.
    pub const FLOAT: i32 = 1;
    /// Type of bytes.
    pub const UINT8: i32 = 2;
    const INT64: i32 = 7;

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct Model {
        #[prost(int64, tag = "1")]
        pub ir_version: i64,
        #[prost(string, tag = "2")]
        pub producer_name: String,
        #[prost(string, tag = "3")]
        pub producer_version: String,
        #[prost(message, optional, tag = "7")]
        pub graph: Option<Graph>,
        #[prost(message, repeated, tag = "8")]
        pub operators: Vec<OperatorSet>,
        #[prost(message, repeated, tag = "14")]
        pub properties: Vec<Property>,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct OperatorSet {
        #[prost(string, tag = "1")]
        pub domain: String,
        #[prost(int64, tag = "2")]
        pub version: i64,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct Property {
        #[prost(string, tag = "1")]
        pub key: String,
        #[prost(string, tag = "2")]
        pub value: String,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct Graph {
        #[prost(message, repeated, tag = "1")]
        pub nodes: Vec<Node>,
        #[prost(string, tag = "2")]
        pub name: String,
        #[prost(message, repeated, tag = "5")]
        pub constants: Vec<Tensor>,
        #[prost(message, repeated, tag = "11")]
        pub inputs: Vec<ValueInfo>,
        #[prost(message, repeated, tag = "12")]
        pub outputs: Vec<ValueInfo>,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct Node {
        #[prost(string, repeated, tag = "1")]
        pub inputs: Vec<String>,
        #[prost(string, repeated, tag = "2")]
        pub outputs: Vec<String>,
        #[prost(string, tag = "3")]
        pub name: String,
        #[prost(string, tag = "4")]
        pub operator: String,
        #[prost(message, repeated, tag = "5")]
        pub attributes: Vec<Attribute>,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct Attribute {
        #[prost(string, tag = "1")]
        pub name: String,
        #[prost(float, optional, tag = "2")]
        pub f: Option<f32>,
        #[prost(int64, optional, tag = "3")]
        pub i: Option<i64>,
        #[prost(int64, repeated, packed = "false", tag = "8")]
        pub ints: Vec<i64>,
        #[prost(int32, tag = "20")]
        pub kind: i32,
    }

    impl Attribute {
        pub fn float(name: &str, value: f32) -> Self {
            Self { name: name.into(), f: Some(value), kind: 1, ..Self::default() }
        }

        pub fn int(name: &str, value: i64) -> Self {
            Self { name: name.into(), i: Some(value), kind: 2, ..Self::default() }
        }

        pub fn ints(name: &str, values: &[i64]) -> Self {
            Self { name: name.into(), ints: values.to_vec(), kind: 7, ..Self::default() }
        }
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct Tensor {
        #[prost(int64, repeated, packed = "false", tag = "1")]
        pub dims: Vec<i64>,
        #[prost(int32, tag = "2")]
        pub kind: i32,
        #[prost(string, tag = "8")]
        pub name: String,
        /// Little-endian, in row-major order.
        #[prost(bytes = "vec", tag = "9")]
        pub raw: Vec<u8>,
    }

    impl Tensor {
        pub fn floats(name: &str, shape: &[usize], values: &[f32]) -> Self {
            let raw = values.iter().flat_map(|value| value.to_le_bytes()).collect();
            Self {
                dims: shape.iter().map(|size| *size as i64).collect(),
                kind: FLOAT,
                name: name.into(),
                raw,
            }
        }

        pub fn numbers(name: &str, values: &[usize]) -> Self {
            let raw = values.iter().flat_map(|value| (*value as i64).to_le_bytes()).collect();
            Self { dims: vec![values.len() as i64], kind: INT64, name: name.into(), raw }
        }
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct ValueInfo {
        #[prost(string, tag = "1")]
        pub name: String,
        #[prost(message, optional, tag = "2")]
        pub kind: Option<Type>,
        #[prost(string, tag = "3")]
        pub told: String,
    }

    impl ValueInfo {
        /// Describes a batch of tensors of `shape`.
        pub fn batch(name: &str, kind: i32, shape: &[usize], told: String) -> Self {
            let batch = Dimension { value: None, name: Some(super::BATCH.into()) };
            let sizes = shape.iter().map(|size| Dimension { value: Some(*size as i64), name: None });
            let shape = Shape { dimensions: std::iter::once(batch).chain(sizes).collect() };
            let tensor = TensorType { kind, shape: Some(shape) };
            Self { name: name.into(), kind: Some(Type { tensor: Some(tensor) }), told }
        }
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct Type {
        #[prost(message, optional, tag = "1")]
        pub tensor: Option<TensorType>,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct TensorType {
        #[prost(int32, tag = "1")]
        pub kind: i32,
        #[prost(message, optional, tag = "2")]
        pub shape: Option<Shape>,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct Shape {
        #[prost(message, repeated, tag = "1")]
        pub dimensions: Vec<Dimension>,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct Dimension {
        #[prost(int64, optional, tag = "1")]
        pub value: Option<i64>,
        #[prost(string, optional, tag = "2")]
        pub name: Option<String>,
    }
}
