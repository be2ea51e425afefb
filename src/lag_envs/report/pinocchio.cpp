// Motions of chains of links by Pinocchio, one state after the other, in RK4 steps. linkage_rivals.py compiles and calls it.
#include <pinocchio/multibody.hpp>
#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/algorithm/crba.hpp>

using pinocchio::SE3;
using Eigen::Vector3d;
using Eigen::VectorXd;
typedef Eigen::Map<const VectorXd> In;

struct Chain {
    pinocchio::Model model;
    pinocchio::Data data;
};

template <class X, class Y, class Z, class Other>
static pinocchio::JointIndex add(pinocchio::Model &model, pinocchio::JointIndex parent, const Vector3d &axis,
                                 const SE3 &place, const std::string &name) {
    if (axis == Vector3d::UnitX()) return model.addJoint(parent, X(), place, name);
    if (axis == Vector3d::UnitY()) return model.addJoint(parent, Y(), place, name);
    if (axis == Vector3d::UnitZ()) return model.addJoint(parent, Z(), place, name);
    return model.addJoint(parent, Other(axis), place, name);
}

extern "C" {

// A row of `links` has 14 numbers: 1 for a hinge or 0 for a slide, axis, place, mass, centre of mass, inertias.
void *make(int n, const double *links) {
    using namespace pinocchio;
    Model model;
    JointIndex parent = 0;
    for (int i = 0; i < n; ++i) {
        const double *l = links + 14 * i;
        const Vector3d axis(l[1], l[2], l[3]), offset(l[4], l[5], l[6]), centre(l[8], l[9], l[10]);
        const Eigen::Matrix3d inertia = Vector3d(l[11], l[12], l[13]).asDiagonal();
        const SE3 place(Eigen::Matrix3d::Identity(), offset);
        const std::string name = "joint" + std::to_string(i);
        parent = l[0] == 0.0
            ? add<JointModelPX, JointModelPY, JointModelPZ, JointModelPrismaticUnaligned>(
                  model, parent, axis, place, name)
            : add<JointModelRX, JointModelRY, JointModelRZ, JointModelRevoluteUnaligned>(
                  model, parent, axis, place, name);
        model.appendBodyToJoint(parent, Inertia(l[7], centre, inertia), SE3::Identity());
    }
    return new Chain{model, Data(model)};
}

void motion(void *chain, const double *q, const double *v, const double *force, const double *field,
            double *acceleration, double *mass) {
    Chain &c = *static_cast<Chain *>(chain);
    const int n = c.model.nv;
    c.model.gravity.linear() = Eigen::Map<const Vector3d>(field);
    const VectorXd place = In(q, n), speed = In(v, n), push = In(force, n);
    Eigen::Map<VectorXd>(acceleration, n) = pinocchio::aba(c.model, c.data, place, speed, push);
    pinocchio::crba(c.model, c.data, place);
    const Eigen::MatrixXd upper = c.data.M.triangularView<Eigen::Upper>();
    Eigen::Map<Eigen::MatrixXd>(mass, n, n) = upper.selfadjointView<Eigen::Upper>();
}

// Rows of `starts` and `ends` have places, then velocities.
void run(void *chain, int count, int steps, double h, const double *starts, const double *forces,
         const double *fields, double *ends) {
    Chain &c = *static_cast<Chain *>(chain);
    const int n = c.model.nv;
    VectorXd q(n), v(n), place(n), v1(n), v2(n), v3(n), force(n), a0(n), a1(n), a2(n), a3(n);
    for (int j = 0; j < count; ++j) {
        q = In(starts + 2 * n * j, n);
        v = In(starts + 2 * n * j + n, n);
        force = In(forces + n * j, n);
        c.model.gravity.linear() = Eigen::Map<const Vector3d>(fields + 3 * j);
        for (int s = 0; s < steps; ++s) {
            a0 = pinocchio::aba(c.model, c.data, q, v, force);
            place = q + 0.5 * h * v;
            v1 = v + 0.5 * h * a0;
            a1 = pinocchio::aba(c.model, c.data, place, v1, force);
            place = q + 0.5 * h * v1;
            v2 = v + 0.5 * h * a1;
            a2 = pinocchio::aba(c.model, c.data, place, v2, force);
            place = q + h * v2;
            v3 = v + h * a2;
            a3 = pinocchio::aba(c.model, c.data, place, v3, force);
            q += h / 6.0 * (v + 2.0 * v1 + 2.0 * v2 + v3);
            v += h / 6.0 * (a0 + 2.0 * a1 + 2.0 * a2 + a3);
        }
        Eigen::Map<VectorXd>(ends + 2 * n * j, n) = q;
        Eigen::Map<VectorXd>(ends + 2 * n * j + n, n) = v;
    }
}
}
