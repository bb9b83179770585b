//! The three solids of the scene, and their intersection with a ray.
//!
//! Each is centered at its own origin, with its height along z.

use nalgebra::Vector3;

/// A convex solid in its own frame, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Shape {
    /// Half extents along x, y, z.
    Box([f64; 3]),
    /// Upright, closed at both ends.
    Cylinder { radius: f64, half_height: f64 },
    /// Half axes along x, y, z.
    Ellipsoid([f64; 3]),
}

/// Intersection of a ray and a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Hit {
    /// Distance along the ray, metres.
    pub(super) range: f64,
    /// Cosine of the angle between the ray and the surface normal; 0 at grazing incidence.
    pub(super) cosine: f64,
}

/// The interval of a ray inside a set. `cosine` belongs to its start.
#[derive(Clone, Copy)]
struct Interval {
    enter: f64,
    exit: f64,
    cosine: f64,
}

impl Shape {
    /// Half extents of the bounding box along x, y, z, metres.
    pub(super) fn half_extents(&self) -> [f64; 3] {
        match *self {
            Shape::Box(half) | Shape::Ellipsoid(half) => half,
            Shape::Cylinder {
                radius,
                half_height,
            } => [radius, radius, half_height],
        }
    }

    /// Radius of the bounding sphere, metres.
    pub(super) fn bounding_radius(&self) -> f64 {
        match *self {
            Shape::Box([x, y, z]) => (x * x + y * y + z * z).sqrt(),
            Shape::Cylinder {
                radius,
                half_height,
            } => radius.hypot(half_height),
            Shape::Ellipsoid([x, y, z]) => x.max(y).max(z),
        }
    }

    /// Entry of a ray with a unit direction into the shape; none where it misses or starts inside.
    pub(super) fn hit(&self, origin: &Vector3<f64>, direction: &Vector3<f64>) -> Option<Hit> {
        let inside = match *self {
            Shape::Box(half) => (0..3)
                .map(|axis| slab(origin[axis], direction[axis], half[axis]))
                .reduce(overlap)??,
            Shape::Cylinder {
                radius,
                half_height,
            } => {
                let mantle = mantle(origin, direction, radius);
                overlap(mantle, slab(origin.z, direction.z, half_height))?
            }
            Shape::Ellipsoid(half) => ellipsoid(origin, direction, half)?,
        };
        (inside.enter > 0.0 && inside.enter <= inside.exit).then_some(Hit {
            range: inside.enter,
            cosine: inside.cosine,
        })
    }
}

fn overlap(a: Option<Interval>, b: Option<Interval>) -> Option<Interval> {
    let (a, b) = (a?, b?);
    let later = if a.enter >= b.enter { a } else { b };
    Some(Interval {
        exit: a.exit.min(b.exit),
        ..later
    })
}

/// The interval within `half` of zero along one axis.
fn slab(origin: f64, direction: f64, half: f64) -> Option<Interval> {
    if direction == 0.0 {
        return (origin.abs() <= half).then_some(Interval {
            enter: f64::NEG_INFINITY,
            exit: f64::INFINITY,
            cosine: 0.0,
        });
    }
    let (a, b) = ((-half - origin) / direction, (half - origin) / direction);
    Some(Interval {
        enter: a.min(b),
        exit: a.max(b),
        cosine: direction.abs(),
    })
}

/// The interval within an infinite upright cylinder.
fn mantle(origin: &Vector3<f64>, direction: &Vector3<f64>, radius: f64) -> Option<Interval> {
    let (o, d) = (origin.xy(), direction.xy());
    let inside = o.norm_squared() - radius * radius;
    if d.norm_squared() == 0.0 {
        return (inside <= 0.0).then_some(Interval {
            enter: f64::NEG_INFINITY,
            exit: f64::INFINITY,
            cosine: 0.0,
        });
    }
    let [enter, exit] = roots(d.norm_squared(), o.dot(&d), inside)?;
    Some(Interval {
        enter,
        exit,
        cosine: ((o + d * enter).dot(&d) / radius).abs(),
    })
}

fn ellipsoid(origin: &Vector3<f64>, direction: &Vector3<f64>, half: [f64; 3]) -> Option<Interval> {
    let half = Vector3::from(half);
    let (o, d) = (origin.component_div(&half), direction.component_div(&half));
    let [enter, exit] = roots(d.norm_squared(), o.dot(&d), o.norm_squared() - 1.0)?;
    let normal = (o + d * enter).component_div(&half).normalize();
    Some(Interval {
        enter,
        exit,
        cosine: normal.dot(direction).abs(),
    })
}

/// Both roots of a t^2 + 2 b t + c, the smaller first.
fn roots(a: f64, b: f64, c: f64) -> Option<[f64; 2]> {
    let square = b * b - a * c;
    (square >= 0.0).then(|| [(-b - square.sqrt()) / a, (-b + square.sqrt()) / a])
}

#[cfg(test)]
impl Shape {
    /// Distance of a point to the surface, metres; for an ellipsoid, along the ray to its center.
    pub(super) fn surface_distance(&self, point: &Vector3<f64>) -> f64 {
        let outside = |gaps: &[f64]| {
            let far = gaps
                .iter()
                .map(|gap| gap.max(0.0).powi(2))
                .sum::<f64>()
                .sqrt();
            let deep = gaps.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            (far + deep.min(0.0)).abs()
        };
        match *self {
            Shape::Box(half) => outside(&[0, 1, 2].map(|axis| point[axis].abs() - half[axis])),
            Shape::Cylinder {
                radius,
                half_height,
            } => outside(&[point.xy().norm() - radius, point.z.abs() - half_height]),
            Shape::Ellipsoid(half) => {
                let scaled = point.component_div(&Vector3::from(half)).norm();
                point.norm() * (1.0 - 1.0 / scaled).abs()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn shapes() -> [Shape; 3] {
        let cylinder = Shape::Cylinder {
            radius: 0.7,
            half_height: 1.1,
        };
        [
            Shape::Box([0.5, 1.0, 1.5]),
            cylinder,
            Shape::Ellipsoid([0.6, 1.2, 0.9]),
        ]
    }

    #[test]
    fn rays_along_an_axis_enter_at_the_near_face() {
        for (shape, range) in shapes().into_iter().zip([4.5, 4.3, 4.4]) {
            let hit = shape
                .hit(&Vector3::new(-5.0, 0.0, 0.0), &Vector3::x())
                .unwrap();
            assert!((hit.range - range).abs() < 1e-12 && (hit.cosine - 1.0).abs() < 1e-12);
            assert_eq!(shape.hit(&Vector3::new(5.0, 0.0, 0.0), &Vector3::x()), None);
            assert_eq!(
                shape.hit(&Vector3::new(-5.0, 3.0, 0.0), &Vector3::x()),
                None
            );
            assert_eq!(shape.hit(&Vector3::zeros(), &Vector3::x()), None);
        }
    }

    #[test]
    fn rays_from_above_meet_the_lid_of_a_cylinder() {
        let hit = shapes()[1]
            .hit(&Vector3::new(0.2, 0.1, 4.0), &-Vector3::z())
            .unwrap();
        assert!((hit.range - 2.9).abs() < 1e-12 && hit.cosine == 1.0);
    }

    proptest! {
        #[test]
        fn a_hit_lies_on_the_surface_and_nothing_lies_before_it(
            from in [-4.0f64..4.0, -4.0f64..4.0, -4.0f64..4.0],
            to in [-1.0f64..1.0, -1.0f64..1.0, -1.0f64..1.0],
        ) {
            let origin = Vector3::from(from);
            let direction = (Vector3::from(to) - origin).normalize();
            for shape in shapes() {
                let Some(hit) = shape.hit(&origin, &direction) else { continue };
                prop_assert!(shape.surface_distance(&(origin + direction * hit.range)) < 1e-9);
                prop_assert!((0.0..=1.0 + 1e-9).contains(&hit.cosine));
                prop_assert!(origin.norm() - hit.range <= shape.bounding_radius() + 1e-9);
            }
        }
    }
}
