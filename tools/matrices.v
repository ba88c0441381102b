(* Matrices of any size by their laws alone; nothing is said of entries, and no axiom is left: what
   holds here holds of whatever has these laws, matrices of real numbers among it. *)
Section Matrices.
Variable Mat : nat -> nat -> Type.
Variable zero : forall {m n}, Mat m n.
Variable one : forall {n}, Mat n n.
Variable add : forall {m n}, Mat m n -> Mat m n -> Mat m n.
Variable opp : forall {m n}, Mat m n -> Mat m n.
Variable mul : forall {m n k}, Mat m n -> Mat n k -> Mat m k.
Variable tr : forall {m n}, Mat m n -> Mat n m.
Infix "+" := add.
Infix "*" := mul.
Notation "- x" := (opp x).
Hypothesis add_assoc : forall m n (a b c : Mat m n), (a + b) + c = a + (b + c).
Hypothesis add_comm : forall m n (a b : Mat m n), a + b = b + a.
Hypothesis add_zero : forall m n (a : Mat m n), a + zero = a.
Hypothesis add_opp : forall m n (a : Mat m n), a + - a = zero.
Hypothesis mul_assoc : forall m n k l (a : Mat m n) (b : Mat n k) (c : Mat k l), (a * b) * c = a * (b * c).
Hypothesis mul_one : forall m n (a : Mat m n), a * one = a.
Hypothesis one_mul : forall m n (a : Mat m n), one * a = a.
Hypothesis mul_add : forall m n k (a : Mat m n) (b c : Mat n k), a * (b + c) = a * b + a * c.
Hypothesis add_mul : forall m n k (a b : Mat m n) (c : Mat n k), (a + b) * c = a * c + b * c.
Hypothesis tr_add : forall m n (a b : Mat m n), tr (a + b) = tr a + tr b.
Hypothesis tr_mul : forall m n k (a : Mat m n) (b : Mat n k), tr (a * b) = tr b * tr a.
Hypothesis tr_tr : forall m n (a : Mat m n), tr (tr a) = a.

Lemma swap m n (a b c : Mat m n) : a + (b + c) = b + (a + c).
Proof. rewrite <- !add_assoc, (add_comm _ _ a b). reflexivity. Qed.
Lemma cancel m n (a b : Mat m n) : a + (- a + b) = b.
Proof. rewrite <- add_assoc, add_opp, add_comm, add_zero. reflexivity. Qed.
Lemma left m n (a b c : Mat m n) : a + b = a + c -> b = c.
Proof. intro H. rewrite <- (add_zero _ _ b), <- (add_zero _ _ c), <- (add_opp _ _ a), !(swap _ _ _ a), <- !(add_assoc _ _ a), H. 
  reflexivity. Qed.
Lemma opp_opp m n (a : Mat m n) : - - a = a.
Proof. apply (left _ _ (- a)). rewrite add_opp, add_comm, add_opp. reflexivity. Qed.
Lemma opp_add m n (a b : Mat m n) : - (a + b) = - a + - b.
Proof. apply (left _ _ (a + b)). rewrite add_opp, add_assoc, (swap _ _ b), cancel, add_opp. reflexivity. Qed.
Lemma zero_mul m n k (c : Mat n k) : (@zero m n) * c = zero.
Proof. apply (left _ _ (zero * c)). rewrite <- add_mul, !add_zero. reflexivity. Qed.
Lemma mul_zero m n k (c : Mat m n) : c * (@zero n k) = zero.
Proof. apply (left _ _ (c * zero)). rewrite <- mul_add, !add_zero. reflexivity. Qed.
Lemma opp_mul m n k (a : Mat m n) (b : Mat n k) : - a * b = - (a * b).
Proof. apply (left _ _ (a * b)). rewrite <- add_mul, !add_opp, zero_mul. reflexivity. Qed.
Lemma mul_opp m n k (a : Mat m n) (b : Mat n k) : a * - b = - (a * b).
Proof. apply (left _ _ (a * b)). rewrite <- mul_add, !add_opp, mul_zero. reflexivity. Qed.
Lemma tr_zero m n : tr (@zero m n) = zero.
Proof. apply (left _ _ (tr zero)). rewrite <- tr_add, !add_zero. reflexivity. Qed.
Lemma tr_opp m n (a : Mat m n) : tr (- a) = - tr a.
Proof. apply (left _ _ (tr a)). rewrite <- tr_add, !add_opp, tr_zero. reflexivity. Qed.
Lemma tr_one n : tr (@one n) = one.
Proof. rewrite <- (mul_one _ _ (tr one)), <- (tr_tr _ _ (tr one * one)), tr_mul, tr_tr, mul_one. apply tr_tr. Qed.
Lemma through m n k l (a : Mat m n) (b : Mat n k) (c : Mat m k) (d : Mat k l) : a * b = c -> a * (b * d) = c * d.
Proof. intro H. rewrite <- mul_assoc, H. reflexivity. Qed.
Lemma cancel_opp m n (a b : Mat m n) : - a + (a + b) = b.
Proof. apply (left _ _ a), cancel. Qed.
Lemma through3 m n k l j (a : Mat m n) (b : Mat n k) (c : Mat k l) (d : Mat m l) (e : Mat l j) :
  a * (b * c) = d -> a * (b * (c * e)) = d * e.
Proof. intro H. rewrite <- H, !mul_assoc. reflexivity. Qed.
Lemma difference m n (a b : Mat m n) : a + (- b + zero) = zero -> a = b.
Proof. rewrite add_zero. intro H. apply (left _ _ (- b)). rewrite (add_comm _ _ _ a), H, add_comm, add_opp. reflexivity. Qed.

(* To sums of products, each product to the right. *)
Ltac expand := repeat first [ rewrite tr_add | rewrite tr_mul | rewrite tr_opp | rewrite tr_one | rewrite tr_tr
  | rewrite mul_add | rewrite add_mul | rewrite opp_mul | rewrite mul_opp | rewrite opp_add | rewrite opp_opp
  | rewrite mul_one | rewrite one_mul | rewrite mul_assoc | rewrite add_assoc
  | match goal with H : tr ?P = ?P |- _ => rewrite H end ].
Ltac bring t := repeat (lazymatch goal with |- _ + (t + _) = _ => fail | _ => progress rewrite (swap _ _ _ t) end).
Ltac pair := lazymatch goal with
  | |- - ?x + _ = _ => bring x; rewrite cancel_opp
  | |- ?x + _ = _ => bring (- x); rewrite cancel
  end.

(* What is given, read from left to right wherever it stands, and its transpose. *)
Ltac use H := repeat (rewrite H || rewrite (through _ _ _ _ _ _ _ _ H) || rewrite (through3 _ _ _ _ _ _ _ _ _ _ H)).
Ltac transposed H H' := pose proof (f_equal (fun x => tr x) H) as H'; cbv beta in H'; revert H'; expand; intro H'.
Ltac equal := apply difference; expand.
Ltac collect := repeat pair; reflexivity.
