//! Fits the logistic regressions of the two probabilities of a point, its confidence and the probability that it
//! moves, and evaluates their calibration.
//!
//! ```text
//! FNSF_REAL_DATA=... cargo bench --bench accuracy -- confidence [DIAGRAM.svg]
//! ```
//!
//! The training data are streets 0 to 11 with 64 and with 32 beams, and the labelled pairs in
//! `FNSF_REAL_DATA` if it is set. The evaluation also uses streets 100 to 109 and 400 to 409, which
//! are not in the training data. Each labelled pair is also evaluated with weights that were fitted
//! without it. Ground points are taken from the masks of the pairs, and the ego motion is
//! estimated.

use super::labelled::{LabelledPair, PAIRS, real_pairs, street};
use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::evaluate::{Calibration, Reliability};
use fnsf::flow::field::Backend;
use fnsf::flow::{
    CONFIDENT_WITHIN_M, ConfidenceFeatures, ObjectOptions, Point, RigidTransform, SearchClouds,
    Uncontrolled,
};
use nalgebra::{DMatrix, DVector, Point3};

const BEAMS: [usize; 2] = [64, 32];
/// Number of training streets per number of beams.
const STREETS: u64 = 12;

/// The features of a point, the end-point error of its flow, and whether it moves.
struct Evaluated {
    kind: usize,
    features: Vec<f64>,
    error_m: f64,
    /// None where the truth does not say it.
    moves: Option<bool>,
}

/// A probability of a point.
#[derive(Clone, Copy)]
enum Probability {
    /// That its error is below [`CONFIDENT_WITHIN_M`].
    Within,
    /// That it moves.
    Moves,
}

impl Probability {
    /// Number of features that it uses. The last feature of all, the displacement, makes the confidence
    /// worse on streets that are not in the fit.
    fn features(self) -> usize {
        match self {
            Self::Within => 12,
            Self::Moves => 13,
        }
    }

    /// Whether the probability is right about a point, where that is known.
    fn is_right(self, point: &Evaluated) -> Option<bool> {
        match self {
            Self::Within => Some(point.error_m < f64::from(CONFIDENT_WITHIN_M)),
            Self::Moves => point.moves,
        }
    }
}

/// The classes, each with separate weights: moving points, static points, ground points.
const KINDS: [&str; 3] = ["MOVING", "STANDING", "GROUND"];

struct Scene {
    name: String,
    /// Weight of the scene in a fit.
    weight: f64,
    points: Vec<Evaluated>,
}

fn moved(motion: &RigidTransform, point: Point) -> Point {
    let moved = motion * Point3::from(point.map(f64::from));
    moved.map(|c| c as f32).into()
}

/// Estimates a pair and collects the features and errors of its points. `weight` is the weight of
/// the scene in a fit.
fn judged(backend: &dyn Backend, known: LabelledPair, weight: f64) -> Scene {
    let rest = RigidTransform::identity();
    let host = backend.host();
    let found = host.align(&known.source, &known.target, &rest, &Uncontrolled);
    let ego = found.motion;
    let off_ground = |points: &[Point], ground: &[bool]| -> Vec<usize> {
        (0..points.len())
            .filter(|&row| !ground[row] && points[row].iter().all(|c| c.is_finite()))
            .collect()
    };
    let rows = off_ground(&known.source, &known.ground[0]);
    let target: Vec<Point> = off_ground(&known.target, &known.ground[1])
        .into_iter()
        .map(|row| known.target[row])
        .collect();
    let aligned: Vec<Point> = rows
        .iter()
        .map(|&row| moved(&ego, known.source[row]))
        .collect();
    let clouds = SearchClouds {
        times: None,
        source: &aligned,
        target: &target,
        neighbors: &[],
        sweeps: [&known.source, &known.target],
        target_from_source: ego,
    };
    let options = ObjectOptions::default();
    let labelled = backend
        .host()
        .find_objects(&clouds, &options, &Uncontrolled);
    let residual = labelled.motions.residual_at(&aligned);
    let error = |row: usize, at: Point| {
        let square = |a: usize| (known.source[row][a] + known.flow[row][a] - at[a]).powi(2);
        f64::from((square(0) + square(1) + square(2)).sqrt())
    };
    let moves = |row: usize| known.dynamic.as_ref().map(|dynamic| dynamic[row]);
    let mut points = Vec::new();
    for (i, &row) in rows
        .iter()
        .enumerate()
        .filter(|&(_, &row)| known.valid[row])
    {
        let at = core::array::from_fn(|a| aligned[i][a] + residual[i][a]);
        let evidence: &ConfidenceFeatures = &labelled.evidence[i];
        points.push(Evaluated {
            kind: usize::from(!evidence.moves),
            features: evidence.features().into_iter().map(f64::from).collect(),
            error_m: error(row, at),
            moves: moves(row),
        });
    }
    for row in (0..known.source.len()).filter(|&row| known.ground[0][row] && known.valid[row]) {
        let at = moved(&ego, known.source[row]);
        if at.iter().all(|c| c.is_finite()) {
            let range = (1.0 + at[0].hypot(at[1]) / 10.0).ln();
            points.push(Evaluated {
                kind: 2,
                features: vec![1.0, f64::from(range)],
                error_m: error(row, at),
                moves: moves(row),
            });
        }
    }
    Scene {
        name: known.name,
        weight,
        points,
    }
}

/// Fits the weights of one class for one probability by Newton's method on the penalized likelihood. The points of a
/// scene share its weight equally. All training streets together weigh as much as three labelled
/// pairs.
fn fitted(scenes: &[&Scene], kind: usize, probability_of: Probability) -> Vec<f64> {
    const PENALTY: f64 = 1e-3;
    const STEPS: usize = 30;
    let count = scenes
        .iter()
        .flat_map(|s| &s.points)
        .find(|p| p.kind == kind)
        .map_or(0, |p| p.features.len().min(probability_of.features()));
    let mut weights = DVector::<f64>::zeros(count);
    for _ in 0..STEPS {
        let mut normal = DMatrix::<f64>::identity(count, count) * PENALTY;
        let mut gradient = -&weights * PENALTY;
        for scene in scenes {
            let of_kind = || {
                let points = scene.points.iter().filter(|p| p.kind == kind);
                points.filter_map(|point| Some((point, probability_of.is_right(point)?)))
            };
            let share = scene.weight / of_kind().count().max(1) as f64;
            for (point, right) in of_kind() {
                let features = DVector::from_column_slice(&point.features[..count]);
                let probability = 1.0 / (1.0 + (-weights.dot(&features)).exp());
                let right = f64::from(u8::from(right));
                gradient.axpy(share * (right - probability), &features, 1.0);
                normal.ger(
                    share * probability * (1.0 - probability),
                    &features,
                    &features,
                    1.0,
                );
            }
        }
        let Some(cholesky) = normal.cholesky() else {
            break;
        };
        weights += cholesky.solve(&gradient);
    }
    weights.iter().copied().collect()
}

fn probability(weights: &[Vec<f64>], point: &Evaluated) -> f64 {
    let sum: f64 = weights[point.kind]
        .iter()
        .zip(&point.features)
        .map(|(w, f)| w * f)
        .sum();
    1.0 / (1.0 + (-sum).exp())
}

/// The calibration of a probability on the points off the ground of some scenes.
struct Told {
    calibration: Calibration,
    /// EPE of the half of the points with the smallest errors, divided by that of the other half.
    /// It is the lower bound of this ratio for any confidence.
    best: f64,
}

impl Told {
    fn new(scenes: &[&Scene], weights: &[Vec<f64>], of: Probability) -> Result<Self, &'static str> {
        let off_ground = scenes.iter().flat_map(|scene| &scene.points);
        let off_ground = || {
            off_ground
                .clone()
                .filter(|point| KINDS[point.kind] != "GROUND")
        };
        let mut reliability = Reliability::default();
        for point in off_ground() {
            if let Some(right) = of.is_right(point) {
                reliability.add(probability(weights, point), right, point.error_m);
            }
        }
        let mut errors: Vec<f64> = off_ground().map(|point| point.error_m).collect();
        errors.sort_by(f64::total_cmp);
        let (least, rest) = errors.split_at(errors.len() / 2);
        Ok(Self {
            calibration: reliability.finish().ok_or("no points")?,
            best: least.iter().sum::<f64>() / rest.iter().sum::<f64>(),
        })
    }

    fn print(&self, name: &str, of: Probability) {
        let Calibration {
            points,
            error,
            recall,
            precision,
            sure_half_epe,
            rest_epe,
            ..
        } = self.calibration;
        let share = |share: Option<f64>| share.map_or("-".to_owned(), |s| format!("{s:.3}"));
        match of {
            Probability::Within => println!(
                "| {name} | {points} | {sure_half_epe:.4} | {rest_epe:.4} | {:.2} | {:.2} | {error:.3} |",
                sure_half_epe / rest_epe,
                self.best,
            ),
            Probability::Moves => println!(
                "| {name} | {points} | {} | {} | {error:.4} |",
                share(recall),
                share(precision)
            ),
        }
    }
}

/// Reliability diagrams side by side: confidence on the x axis, the share of correct points on the
/// y axis. The area of a circle grows with the number of points in its bin.
fn diagram(shown: &[(String, Told)]) -> String {
    const SIDE: f64 = 240.0;
    const MARGIN: f64 = 46.0;
    let step = SIDE + MARGIN * 1.4;
    let (width, height) = (MARGIN + step * shown.len() as f64, SIDE + MARGIN * 2.0);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width:.0} {height:.0}\" \
         font-family=\"sans-serif\" font-size=\"12\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\n"
    );
    for (index, (name, told)) in shown.iter().enumerate() {
        let Calibration { error, bins, .. } = &told.calibration;
        let (left, top) = (MARGIN + step * index as f64, MARGIN);
        let at = |said: f64, right: f64| (left + said * SIDE, top + (1.0 - right) * SIDE);
        let ((x0, y0), (x1, y1)) = (at(0.0, 0.0), at(1.0, 1.0));
        svg += &format!(
            "<rect x=\"{x0:.1}\" y=\"{y1:.1}\" width=\"{SIDE}\" height=\"{SIDE}\" fill=\"none\" stroke=\"#888\"/>\n\
             <line x1=\"{x0:.1}\" y1=\"{y0:.1}\" x2=\"{x1:.1}\" y2=\"{y1:.1}\" stroke=\"#bbb\" stroke-dasharray=\"4 4\"/>\n\
             <text x=\"{x0:.1}\" y=\"{:.1}\">{name}: calibration error {:.3}</text>\n\
             <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">confidence</text>\n\
             <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">1</text>\n\
             <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">0</text>\n",
            y1 - 10.0,
            error,
            (x0 + x1) / 2.0,
            y0 + 18.0,
            x0 - 5.0,
            y1 + 4.0,
            x0 - 5.0,
            y0 + 4.0,
        );
        let line: Vec<String> = bins
            .iter()
            .map(|bin| at(bin.probability, bin.right))
            .map(|(x, y)| format!("{x:.1},{y:.1}"))
            .collect();
        svg += &format!(
            "<polyline points=\"{}\" fill=\"none\" stroke=\"#1f77b4\"/>\n",
            line.join(" ")
        );
        for bin in bins {
            let (x, y) = at(bin.probability, bin.right);
            let radius = 2.0 + 12.0 * bin.share.sqrt();
            svg += &format!(
                "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius:.1}\" fill=\"#1f77b4\" fill-opacity=\"0.6\"/>\n"
            );
        }
    }
    svg + "</svg>\n"
}

/// All scenes: the labelled pairs, the streets of the fit, and those that are not in it.
struct Scenes {
    pairs: Vec<Scene>,
    known: Vec<Scene>,
    fresh: Vec<Scene>,
    more: Vec<Scene>,
}

impl Scenes {
    fn new() -> Result<Self, String> {
        let backend = CpuBackend::new(None).map_err(|error| error.to_string())?;
        let pairs = real_pairs()?.into_iter();
        let weight = PAIRS.len() as f64 / (STREETS as usize * BEAMS.len()) as f64;
        let streets = |seeds: std::ops::Range<u64>| -> Result<Vec<Scene>, String> {
            let each = seeds.flat_map(|seed| BEAMS.map(|beams| street(seed, beams)));
            each.map(|known| Ok(judged(&backend, known?, weight)))
                .collect()
        };
        Ok(Self {
            pairs: pairs.map(|pair| judged(&backend, pair, 1.0)).collect(),
            known: streets(0..STREETS)?,
            fresh: streets(100..110)?,
            more: streets(400..410)?,
        })
    }

    /// Fits the weights of a probability, prints them and the table of its calibration, and returns what
    /// the diagram shows.
    fn evaluate(&self, of: Probability) -> Result<Vec<(String, Told)>, String> {
        let all: Vec<&Scene> = self.known.iter().chain(&self.pairs).collect();
        let fitted = |scenes: &[&Scene]| -> Vec<Vec<f64>> {
            let kinds = 0..KINDS.len();
            kinds.map(|kind| fitted(scenes, kind, of)).collect()
        };
        let weights = fitted(&all);
        for (kind, weights) in KINDS.iter().zip(&weights) {
            println!("{kind}: {weights:.3?}");
        }
        match of {
            Probability::Within => println!(
                "\n| scenes | points | sure half | rest | ratio | best ratio | calibration error |\n\
                 |---|---|---|---|---|---|---|"
            ),
            Probability::Moves => println!(
                "\n| scenes | points | recall at 0.5 | precision at 0.5 | calibration error |\n\
                 |---|---|---|---|---|"
            ),
        }
        let told = |name: &str, scenes: &[&Scene], weights: &[Vec<f64>]| {
            let told = Told::new(scenes, weights, of)?;
            told.print(name, of);
            Ok::<_, &'static str>((name.to_owned(), told))
        };
        let mut shown = Vec::new();
        for (name, scenes) in [
            ("fitted streets", &self.known),
            ("streets 100 to 109", &self.fresh),
            ("streets 400 to 409", &self.more),
        ] {
            shown.push(told(name, &scenes.iter().collect::<Vec<_>>(), &weights)?);
        }
        // The diagram shows one set of streets, and the pairs.
        shown = vec![shown.swap_remove(1)];
        for pair in &self.pairs {
            if pair.points.iter().all(|point| of.is_right(point).is_none()) {
                continue;
            }
            told(&pair.name, &[pair], &weights)?;
            let others = all.iter().copied().filter(|other| other.name != pair.name);
            let others = fitted(&others.collect::<Vec<_>>());
            let name = format!("{}, left out of the fit", pair.name);
            let (_, left_out) = told(&name, &[pair], &others)?;
            shown.push((pair.name.clone(), left_out));
        }
        Ok(shown)
    }
}

pub(super) fn run(arguments: &[String]) -> Result<(), String> {
    let scenes = Scenes::new()?;
    println!("## Probability that a point moves");
    scenes.evaluate(Probability::Moves)?;
    println!("\n## Confidence");
    let shown = scenes.evaluate(Probability::Within)?;
    if let Some(path) = arguments.first() {
        std::fs::write(path, diagram(&shown)).map_err(|error| format!("{path}: {error}"))?;
    }
    Ok(())
}
