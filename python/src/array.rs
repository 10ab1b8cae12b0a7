//! NumPy arrays over Rust's memory, and Rust vectors from NumPy arrays, by Python's buffer protocol.
//!
//! The crate numpy could do this too. However, it turns on the feature `std` of `num-complex`, on which gemm and candle
//! depend, so cargo would compile these crates twice.

use harness::spec::{Definition, IMAGE_CHANNELS};
use pyo3::buffer::{Element, PyBuffer};
use pyo3::call::PyCallArgs;
use pyo3::exceptions::{PyBufferError, PyTypeError, PyValueError};
use pyo3::ffi;
use pyo3::prelude::*;
use std::any::Any;
use std::ffi::{CStr, c_int, c_void};
use std::ptr::null_mut;

/// A type of an array's values.
pub trait Item: Element + Send + Sync + 'static {
    /// Its name in NumPy, such as `float32`.
    const NAME: &str;
    /// Its format in the buffer protocol, such as `f`.
    const FORMAT: &CStr;
}

impl Item for f32 {
    const NAME: &str = "float32";
    const FORMAT: &CStr = c"f";
}
impl Item for f64 {
    const NAME: &str = "float64";
    const FORMAT: &CStr = c"d";
}
impl Item for i64 {
    const NAME: &str = "int64";
    const FORMAT: &CStr = c"q";
}
impl Item for u8 {
    const NAME: &str = "uint8";
    const FORMAT: &CStr = c"B";
}

/// The memory of an array in row-major order. NumPy keeps it as long as the array.
#[pyclass(frozen, module = "harness._harness")]
struct Memory {
    /// Owns the values to which `start` points.
    _owner: Box<dyn Any + Send + Sync>,
    start: *mut c_void,
    bytes: usize,
    item_bytes: usize,
    format: &'static CStr,
    shape: Vec<ffi::Py_ssize_t>,
    strides: Vec<ffi::Py_ssize_t>,
    read_only: bool,
}

// SAFETY: its fields never change, and its memory is used only by the thread that holds the interpreter's lock.
unsafe impl Send for Memory {}
// SAFETY: as above.
unsafe impl Sync for Memory {}

impl Memory {
    /// `start` must point to as many values as `shape` has. `owner` must own them, and nothing else may change them.
    fn new<T: Item>(
        owner: Box<dyn Any + Send + Sync>,
        start: *mut T,
        shape: &[usize],
        read_only: bool,
    ) -> Self {
        let item_bytes = size_of::<T>();
        let mut strides: Vec<ffi::Py_ssize_t> = vec![item_bytes as ffi::Py_ssize_t; shape.len()];
        for axis in (1..shape.len()).rev() {
            strides[axis - 1] = strides[axis] * shape[axis] as ffi::Py_ssize_t;
        }
        Self {
            _owner: owner,
            start: start.cast(),
            bytes: item_bytes * shape.iter().product::<usize>(),
            item_bytes,
            format: T::FORMAT,
            shape: shape.iter().map(|size| *size as ffi::Py_ssize_t).collect(),
            strides,
            read_only,
        }
    }
}

#[pymethods]
impl Memory {
    unsafe fn __getbuffer__(slf: Bound<Self>, view: *mut ffi::Py_buffer, flags: c_int) -> PyResult<()> {
        let memory = slf.get();
        if memory.read_only && flags & ffi::PyBUF_WRITABLE != 0 {
            return Err(PyBufferError::new_err("the memory can't be written"));
        }
        let asked = |flag: c_int| flags & flag == flag;
        // SAFETY: Python passes a view to fill in. The pointers in it are valid as long as `obj`, which the view owns.
        unsafe {
            (*view).buf = memory.start;
            (*view).len = memory.bytes as ffi::Py_ssize_t;
            (*view).readonly = memory.read_only.into();
            (*view).itemsize = memory.item_bytes as ffi::Py_ssize_t;
            (*view).format =
                if asked(ffi::PyBUF_FORMAT) { memory.format.as_ptr().cast_mut() } else { null_mut() };
            (*view).ndim = memory.shape.len() as c_int;
            (*view).shape = if asked(ffi::PyBUF_ND) { memory.shape.as_ptr().cast_mut() } else { null_mut() };
            (*view).strides =
                if asked(ffi::PyBUF_STRIDES) { memory.strides.as_ptr().cast_mut() } else { null_mut() };
            (*view).suboffsets = null_mut();
            (*view).internal = null_mut();
            (*view).obj = slf.into_any().into_ptr();
        }
        Ok(())
    }
}

fn as_array<'py>(py: Python<'py>, memory: Memory) -> PyResult<Bound<'py, PyAny>> {
    asarray(py, (Bound::new(py, memory)?,))
}

/// Calls `numpy.asarray`.
fn asarray<'py>(py: Python<'py>, arguments: impl PyCallArgs<'py>) -> PyResult<Bound<'py, PyAny>> {
    py.import("numpy")?.call_method1("asarray", arguments)
}

/// Returns values as an array of this shape, without copying.
pub fn array<'py, T: Item>(
    py: Python<'py>,
    mut values: Vec<T>,
    shape: &[usize],
) -> PyResult<Bound<'py, PyAny>> {
    assert_eq!(values.len(), shape.iter().product::<usize>(), "an array has as many values as its shape");
    let start = values.as_mut_ptr();
    as_array(py, Memory::new(Box::new(values), start, shape, false))
}

/// Returns values that `owner` owns as a read-only array, without copying.
///
/// # Safety
/// The values must neither move nor change as long as `owner` lives.
pub unsafe fn view<'py, O, T: Item>(
    owner: &Bound<'py, O>,
    values: &[T],
    shape: &[usize],
) -> PyResult<Bound<'py, PyAny>> {
    assert_eq!(values.len(), shape.iter().product::<usize>(), "an array has as many values as its shape");
    let start = values.as_ptr().cast_mut();
    let holder: Py<PyAny> = owner.clone().into_any().unbind();
    as_array(owner.py(), Memory::new(Box::new(holder), start, shape, true))
}

/// Returns frames `[frame, channel, row, column]` as a view `[frame, row, column, channel]`.
pub fn pixels_last(planes: Bound<PyAny>) -> PyResult<Bound<PyAny>> {
    planes.call_method1("transpose", (0, 2, 3, 1))
}

/// Returns what is given as a NumPy array. Lists and tensors are converted.
///
/// # Errors
/// TypeError unless it consists of numbers. `name` is its name in the message.
pub fn as_numbers<'py>(name: &str, given: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    let wrong = || PyTypeError::new_err(format!("'{name}' must be an array or a list of numbers"));
    let array = asarray(given.py(), (given,)).map_err(|_| wrong())?;
    let kind: String = array.getattr("dtype")?.getattr("kind")?.extract()?;
    if matches!(kind.as_str(), "f" | "i" | "u") { Ok(array) } else { Err(wrong()) }
}

/// The shape of a sample's values: `[elements]` or `[rows, columns, 3]`.
pub fn shape(definition: &Definition) -> Vec<usize> {
    match definition.size() {
        Some([rows, columns]) => vec![rows, columns, IMAGE_CHANNELS],
        None => vec![definition.width()],
    }
}

/// Returns the shape of a NumPy array.
pub fn shape_of(array: &Bound<PyAny>) -> PyResult<Vec<usize>> {
    array.getattr("shape")?.extract()
}

/// Reads numbers in row-major order. Numbers of another type or byte order, and lists, are converted. `name` is their
/// name in error messages.
///
/// # Errors
/// TypeError unless these are numbers, and ValueError if they have another shape.
pub fn read<T: Item>(name: &str, given: &Bound<PyAny>, shape: &[usize]) -> PyResult<Vec<T>> {
    // A buffer of the other byte order would be taken as it is.
    let native = asarray(given.py(), (as_numbers(name, given)?, T::NAME))?;
    let buffer = PyBuffer::<T>::get(&native)?;
    if buffer.shape() != shape {
        return Err(PyValueError::new_err(format!(
            "'{name}' has the shape {:?}, must be {shape:?}",
            buffer.shape()
        )));
    }
    buffer.to_vec(given.py())
}

/// Returns a number that must not be negative, such as an index.
///
/// # Errors
/// ValueError if it is negative or too large. `name` is its name in the message.
pub fn natural<T: TryFrom<i64>>(name: &str, number: i64) -> PyResult<T> {
    let problem = if number < 0 { "must not be negative" } else { "is too large" };
    T::try_from(number).map_err(|_| PyValueError::new_err(format!("{name}: {number} {problem}")))
}

/// Returns values that must be finite numbers.
///
/// # Errors
/// ValueError if one is infinite or not a number. `name` is their name in the message.
pub fn finite(name: &str, values: Vec<f32>) -> PyResult<Vec<f32>> {
    match values.iter().find(|value| !value.is_finite()) {
        Some(value) => Err(PyValueError::new_err(format!("'{name}' has the value {value}, must be finite"))),
        None => Ok(values),
    }
}

/// Reads a batch of images `[batch, rows, columns, 3]` and returns it as `[batch, channel, row, column]`. Images may be
/// uint8, which is divided by 255, or floating-point numbers in [0, 1]. Differences of images are floating-point
/// numbers in [-1, 1].
///
/// # Errors
/// The same as [`read`], TypeError for whole numbers of other types, and ValueError for numbers that are clearly out of
/// range, such as bytes that were converted to floating-point numbers.
pub fn read_frames(definition: &Definition, given: &Bound<PyAny>, batch: usize) -> PyResult<Vec<f32>> {
    let [rows, columns] = definition.size().unwrap_or_default();
    let (shape, name) = ([batch, rows, columns, IMAGE_CHANNELS], definition.name.name());
    if definition.difference_of.is_none() && PyBuffer::<u8>::get(given).is_ok() {
        let bytes: Vec<u8> = read(name, given, &shape)?;
        return Ok(planes(&bytes, definition.width()).map(|byte| f32::from(byte) / 255.0).collect());
    }
    let (least, allowed) = match definition.difference_of {
        None => (0.0, "uint8, or float in [0, 1]"),
        Some(_) => (-1.0, "float in [-1, 1]"),
    };
    let kind: String = as_numbers(name, given)?.getattr("dtype")?.getattr("kind")?.extract()?;
    if kind != "f" {
        return Err(PyTypeError::new_err(format!("'{name}' must be {allowed}")));
    }
    let values: Vec<f32> = read(name, given, &shape)?;
    // Images that a network predicted may be a little out of range.
    let plausible = least - 1.0..=2.0;
    if let Some(value) = values.iter().find(|value| !plausible.contains(*value)) {
        return Err(PyValueError::new_err(format!("'{name}' has the value {value}, must be {allowed}")));
    }
    Ok(planes(&values, definition.width()).collect())
}

/// Reorders frames of `len` values from `[row, column, channel]` to `[channel, row, column]`.
fn planes<T: Copy>(pixels: &[T], len: usize) -> impl Iterator<Item = T> {
    pixels.chunks_exact(len).flat_map(|frame| {
        (0..IMAGE_CHANNELS)
            .flat_map(move |channel| frame.iter().skip(channel).step_by(IMAGE_CHANNELS).copied())
    })
}
