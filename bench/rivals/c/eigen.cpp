// Kalman filter with Eigen's fixed-size matrices in the textbook form; no checks, no missing rows.
#include "eigen.h"

#include <cmath>

#include <Eigen/Dense>

#include MODEL

template <int R, int C> using Matrix = Eigen::Matrix<double, R, C, (C == 1) ? Eigen::ColMajor : Eigen::RowMajor>;
template <int R, int C> using View = Eigen::Map<Matrix<R, C>>;
template <int R, int C> using Constant = Eigen::Map<const Matrix<R, C>>;

extern "C" void hand_init(hand_t *f)
{
    *f = hand_t();
    View<NX, NX>(f->P) = Constant<NX, NX>(P0_);
}

extern "C" int hand_step(hand_t *f, const double *y)
{
    const Constant<NX, NX> A(A_), Q(Q_);
    const Constant<NY, NX> C(C_);
    const Constant<NY, NY> R(R_);
    View<NX, 1> x(f->x), xf(f->xf);
    View<NX, NX> P(f->P), Pf(f->Pf);
    View<NY, 1> e(f->innovation);
    View<NY, NY> S(f->S);
    const Matrix<NX, NY> W = P * C.transpose();
    S.noalias() = C * W + R;
    const Eigen::LLT<Matrix<NY, NY>> root(S);
    const Matrix<NY, NX> Kt = root.solve(W.transpose());
    e.noalias() = Constant<NY, 1>(y) - C * x;
    const Matrix<NY, 1> whitened = root.matrixL().solve(e);
    f->nis = whitened.squaredNorm();
    double determinant = NY * 1.8378770664093453;
    for (int i = 0; i < NY; ++i)
    {
        determinant += 2.0 * std::log(root.matrixLLT()(i, i));
    }
    f->log_likelihood = -0.5 * (f->nis + determinant);
    xf.noalias() = x + Kt.transpose() * e;
    Pf.noalias() = P - Kt.transpose() * W.transpose();
    x.noalias() = A * xf;
    P.noalias() = A * (Pf * A.transpose()) + Q;
    return 0;
}
