//! Scores of a flow against its truth.

use fnsf::formats::{FlowFile, Ground, Pair, PairTruth};
use fnsf::scores::Scores;
use numpy::PyReadonlyArray1;
use pyo3::prelude::*;

use crate::arrays::{Mask, Matrix, PointArray, Values, column, motion, points};
use crate::errors::{input, internal};

/// The arrays of an estimate: flow, valid, dynamic, confidence, moving.
type Estimated<'py> = (
    PointArray<'py>,
    Option<Mask<'py>>,
    Option<Mask<'py>>,
    Option<Values<'py>>,
    Option<Values<'py>>,
);

/// The arrays of a truth: source, flow, valid, dynamic, foreground, category, ground.
type Known<'py> = (
    Option<PointArray<'py>>,
    PointArray<'py>,
    Option<Mask<'py>>,
    Option<Mask<'py>>,
    Option<Mask<'py>>,
    Option<PyReadonlyArray1<'py, u8>>,
    Option<Mask<'py>>,
);

/// Every metric of an estimate, as JSON.
#[pyfunction]
#[pyo3(signature = (estimated, known, ego=None))]
pub(crate) fn evaluate(
    estimated: Estimated<'_>,
    known: Known<'_>,
    ego: Option<Matrix<'_>>,
) -> PyResult<String> {
    let (flow, valid, dynamic, confidence, moving) = estimated;
    let flow = points("flow", &flow)?;
    let rows = flow.len();
    let mask = |name: &str, mask: Option<Mask<'_>>| {
        let mask = mask.map(|mask| column(name, &mask, rows));
        mask.transpose()
    };
    let values = |name: &str, values: Option<Values<'_>>| {
        let values = values.map(|values| column(name, &values, rows));
        values.transpose()
    };
    let file = FlowFile {
        valid: mask("valid", valid)?,
        dynamic: mask("dynamic", dynamic)?,
        confidence: values("confidence", confidence)?,
        moving: values("moving", moving)?,
        flow,
        ..FlowFile::default()
    };
    let (source, flow, valid, dynamic, foreground, category, ground) = known;
    let category = category.map(|category| column("the truth's category", &category, rows));
    let truth = PairTruth {
        flow: points("the true flow", &flow)?,
        valid: mask("the truth's valid", valid)?.unwrap_or_else(|| vec![true; rows]),
        dynamic: mask("the truth's dynamic", dynamic)?,
        foreground: mask("the truth's foreground", foreground)?,
        category: category.transpose()?,
    };
    let ground = mask("the truth's ground", ground)?.map(|source| Ground {
        source,
        target: Vec::new(),
    });
    let source = source.map(|source| points("source", &source)).transpose()?;
    let pair = Pair {
        source: source.unwrap_or_default(),
        ground,
        ego: ego.map(|ego| motion("ego", &ego)).transpose()?,
        ..Pair::default()
    };
    let mut scores = Scores::default();
    scores.add(&file, &truth, &pair).map_err(input)?;
    let report = scores.report(None).map_err(input)?;
    serde_json::to_string(&report).map_err(internal)
}
