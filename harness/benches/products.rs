//! Times only the matrix products of one training step, computed by gemm, for comparison with training_step.rs.
//!
//!     cargo run --release --example products -- --channels 16 --latent 64 --steps 10  # the paper's network
//!     cargo run --release --example products -- --latent 4  # a network for vectors
//!
//! Only the paper's networks are supported: at most one convolution, and one hidden layer. The products of a layer are
//! the forward product, that of the gradient of the weights and, unless the input is data, that of the gradient of the
//! input. They run through the gemm crate with the features that the harness uses. The products of convolutions run
//! frame by frame, and each thread multiplies patches that stay in its cache, which is the fastest way.
//!
//! Prints one line of JSON with the median, the least and the greatest number of seconds for all products, and the list
//! of products, which products.py times in PyTorch.

use clap::Parser;
use gemm::Parallelism;
use harness::spec::IMAGE_CHANNELS;

/// Sizes of the finger: number of joints, number of the action's elements, side of an image in pixels.
const JOINTS: usize = 20;
const ARM_JOINTS: usize = 3;
const FRAME_SIDE: usize = 64;
use rayon::prelude::*;
use serde::Serialize;
use std::time::Instant;

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

#[derive(Parser)]
struct Arguments {
    /// Output channels of the convolution; without any, the network is for vectors alone.
    #[arg(long, num_args = 0..)]
    channels: Vec<usize>,
    /// Width of the hidden layer.
    #[arg(long, default_value_t = 256)]
    hidden: usize,
    /// Size of the latent state.
    #[arg(long, default_value_t = 64)]
    latent: usize,
    /// Number of samples in a step.
    #[arg(long, default_value_t = 1024)]
    batch: usize,
    /// Number of timed steps.
    #[arg(long, default_value_t = 20)]
    steps: usize,
}

/// The product of `[rows, inner]` and `[inner, columns]`.
#[derive(Clone, Serialize)]
struct Product {
    name: String,
    rows: usize,
    inner: usize,
    columns: usize,
    /// Whether each factor is stored as its transpose.
    transposed: [bool; 2],
    /// 0 for one product over the whole batch. Otherwise the number of products, one for each frame.
    frames: usize,
}

impl Product {
    fn new(name: String, [rows, inner, columns]: [usize; 3], transposed: [bool; 2]) -> Self {
        Self { name, rows, inner, columns, transposed, frames: 0 }
    }

    fn operations(&self) -> f64 {
        2.0 * (self.rows * self.inner * self.columns * self.frames.max(1)) as f64
    }
}

/// Returns the products of a fully connected layer. A layer that reads data needs no gradient of its input.
fn layer(name: &str, batch: usize, inputs: usize, outputs: usize, on_data: bool) -> Vec<Product> {
    let mut products = vec![
        Product::new(format!("{name}, forward"), [batch, inputs, outputs], [false, true]),
        Product::new(format!("{name}, weight gradient"), [outputs, batch, inputs], [true, false]),
    ];
    if !on_data {
        products.push(Product::new(
            format!("{name}, input gradient"),
            [batch, outputs, inputs],
            [false, false],
        ));
    }
    products
}

/// Returns all products of a step.
fn products(arguments: &Arguments) -> Vec<Product> {
    let Arguments { latent, hidden, batch, .. } = *arguments;
    let positions = (FRAME_SIDE / 2) * (FRAME_SIDE / 2);
    let patch = IMAGE_CHANNELS * 4 * 4;
    let mut list = Vec::new();
    if let Some(&channels) = arguments.channels.first() {
        let mut by_frame = |name: &str, shape, transposed| {
            list.push(Product { frames: batch, ..Product::new(name.to_owned(), shape, transposed) });
        };
        by_frame("encoder.conv, forward", [channels, patch, positions], [false, false]);
        by_frame("encoder.conv, weight gradient", [channels, positions, patch], [false, true]);
        by_frame("decoder.conv, forward", [patch, channels, positions], [true, false]);
        by_frame("decoder.conv, weight gradient", [channels, positions, patch], [false, true]);
        by_frame("decoder.conv, input gradient", [channels, patch, positions], [false, false]);
        list.extend(layer("encoder.hidden_frame", batch, channels * positions, hidden, false));
        list.extend(layer("decoder.frame", batch, hidden, channels * positions, false));
    }
    list.extend(layer("encoder.hidden_vector", batch, JOINTS, hidden, true));
    list.extend(layer("encoder.posterior", batch, hidden, 2 * latent, false));
    list.extend(layer("decoder.hidden", batch, latent + ARM_JOINTS, hidden, false));
    list.extend(layer("decoder.vector", batch, hidden, 2 * JOINTS, false));
    list
}

/// The factors and the result of one product.
struct Operands {
    product: Product,
    left: Vec<f32>,
    right: Vec<f32>,
    out: Vec<f32>,
}

impl Operands {
    fn new(product: Product) -> Self {
        // Values are small, so that no result is denormal or infinite.
        let filled = |len: usize| (0..len).map(|i| (i % 17) as f32 / 17.0 - 0.5).collect::<Vec<f32>>();
        Self {
            left: filled(product.rows * product.inner),
            right: filled(product.inner * product.columns),
            out: vec![0.0; product.rows * product.columns],
            product,
        }
    }

    fn run(&mut self, threads: usize) {
        if self.product.frames == 0 {
            return self.multiply(if threads > 1 { Parallelism::Rayon(threads) } else { Parallelism::None });
        }
        let share = self.product.frames.div_ceil(threads);
        (0..threads).into_par_iter().for_each(|_| {
            let mut own = Self::new(self.product.clone());
            (0..share).for_each(|_| own.multiply(Parallelism::None));
        });
    }

    fn multiply(&mut self, parallelism: Parallelism) {
        let Product { rows, inner, columns, transposed, .. } = self.product;
        // Returns the column stride and the row stride of a row-major matrix of this size, or of its transpose.
        let strides = |width: usize, height: usize, transposed: bool| {
            if transposed { (height as isize, 1) } else { (1, width as isize) }
        };
        let (left_columns, left_rows) = strides(inner, rows, transposed[0]);
        let (right_columns, right_rows) = strides(columns, inner, transposed[1]);
        // SAFETY: `new` created each matrix with the size of its shape, which the strides cover, and none overlap.
        unsafe {
            gemm::gemm(
                rows,
                columns,
                inner,
                self.out.as_mut_ptr(),
                1,
                columns as isize,
                false,
                self.left.as_ptr(),
                left_columns,
                left_rows,
                self.right.as_ptr(),
                right_columns,
                right_rows,
                0.0_f32,
                1.0,
                false,
                false,
                false,
                parallelism,
            );
        }
    }
}

fn main() {
    let arguments = Arguments::parse();
    if arguments.channels.len() > 1 {
        eprintln!("products: --channels takes one number or none: deeper networks are not supported");
        std::process::exit(2);
    }
    let threads = rayon::current_num_threads();
    let products = products(&arguments);
    let operations: f64 = products.iter().map(Product::operations).sum();
    let mut operands: Vec<_> = products.iter().cloned().map(Operands::new).collect();
    let mut seconds = Vec::with_capacity(arguments.steps);
    for _ in 0..arguments.steps + 2 {
        let begin = Instant::now();
        operands.iter_mut().for_each(|operands| operands.run(threads));
        seconds.push(begin.elapsed().as_secs_f64());
    }
    // The first two steps warm up caches and the allocator.
    let mut seconds = seconds.split_off(2);
    seconds.sort_by(f64::total_cmp);
    println!(
        "{}",
        serde_json::json!({
            "channels": arguments.channels, "latent": arguments.latent, "batch": arguments.batch,
            "median_seconds": seconds[seconds.len() / 2], "min_seconds": seconds[0],
            "max_seconds": seconds[seconds.len() - 1],
            "gigaflop": operations / 1e9, "threads": threads, "products": products,
        })
    );
}
