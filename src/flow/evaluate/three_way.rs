//! Three-way EPE: mean over foreground dynamic, foreground static and background static.
//!
//! The official Argoverse 2 definition: each part is pooled over the points of all sweeps, and the
//! three parts have the same weight. Dynamic background points belong to no part, as in the
//! official code.

use super::truth::Mean;

/// The EPE of one of the three sets of points of a three-way EPE.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Part {
    /// Mean end-point error, metres; none if the part has no points.
    pub epe: Option<f64>,
    /// Number of scored points of the part.
    pub points: usize,
}

/// Three-way EPE (Argoverse 2) and its parts. Dynamic background points belong to no part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ThreeWay {
    /// Mean of the EPE of the three parts, with equal weights, metres. None if a part has no
    /// points: the official mean is then NaN, and a mean over two parts would not be comparable
    /// with one over three.
    pub epe: Option<f64>,
    /// Dynamic points on objects.
    pub foreground_dynamic: Part,
    /// Static points on objects.
    pub foreground_static: Part,
    /// Static points of the background.
    pub background_static: Part,
}

/// Accumulator of the three parts.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct ThreeWaySums {
    asked: bool,
    foreground_dynamic: Mean,
    foreground_static: Mean,
    background_static: Mean,
}

impl ThreeWaySums {
    /// Adds the end-point error of one point, metres.
    pub(super) fn add(&mut self, error: f64, [foreground, dynamic]: [bool; 2]) {
        self.asked = true;
        match (foreground, dynamic) {
            (true, true) => self.foreground_dynamic.add(error),
            (true, false) => self.foreground_static.add(error),
            (false, false) => self.background_static.add(error),
            (false, true) => {}
        }
    }

    /// The parts and their mean; none if no point with masks was added.
    pub(super) fn finish(&self) -> Option<ThreeWay> {
        let part = |mean: Mean| Part {
            epe: mean.value(),
            points: mean.count,
        };
        let foreground_dynamic = part(self.foreground_dynamic);
        let foreground_static = part(self.foreground_static);
        let background_static = part(self.background_static);
        let epe = foreground_dynamic
            .epe
            .zip(foreground_static.epe)
            .zip(background_static.epe)
            .map(|((moving, standing), world)| (moving + standing + world) / 3.0);
        self.asked.then_some(ThreeWay {
            epe,
            foreground_dynamic,
            foreground_static,
            background_static,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_weigh_the_same_whatever_their_points() {
        let mut sums = ThreeWaySums::default();
        sums.add(0.9, [true, true]);
        sums.add(0.2, [true, false]);
        sums.add(0.4, [true, false]);
        for _ in 0..100 {
            sums.add(0.0, [false, false]);
        }
        sums.add(50.0, [false, true]);
        let three_way = sums.finish().unwrap();
        assert!((three_way.epe.unwrap() - 0.4).abs() < 1e-12);
        assert_eq!(three_way.foreground_static.points, 2);
        assert_eq!(three_way.background_static.points, 100);
    }

    #[test]
    fn a_missing_part_leaves_the_mean_out_and_keeps_the_others() {
        let mut sums = ThreeWaySums::default();
        assert_eq!(sums.finish(), None);
        sums.add(0.5, [false, false]);
        let three_way = sums.finish().unwrap();
        assert_eq!(three_way.epe, None);
        assert_eq!(three_way.background_static.epe, Some(0.5));
        assert_eq!(three_way.foreground_dynamic.points, 0);
    }
}
